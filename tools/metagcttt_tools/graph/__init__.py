"""Driving the ROS graph: its processes, its client, the episodes."""
