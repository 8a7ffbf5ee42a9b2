"""The mazes of OGBench and gymnasium-robotics behind the simulator interface."""
