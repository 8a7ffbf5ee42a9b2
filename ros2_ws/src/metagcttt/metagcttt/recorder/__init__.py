"""Recording of a robot's topics as MCAP."""
