"""The live view of a running graph, in a browser."""
