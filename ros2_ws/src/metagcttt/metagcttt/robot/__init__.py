"""The bridge to a robot that speaks standard messages, by its contract."""
