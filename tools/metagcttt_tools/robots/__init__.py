"""Recordings of robots that speak standard messages, read by their contracts."""
