"""The adapter node: adapts to goals of many robots, one expert for each request."""
