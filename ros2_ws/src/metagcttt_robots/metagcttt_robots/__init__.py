"""Robots to try a policy on: simulated, in processes that know of standard messages alone."""
