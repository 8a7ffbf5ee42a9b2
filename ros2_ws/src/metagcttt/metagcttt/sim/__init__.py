"""The simulator on the graph: publishes maze states and steps with the actions it is sent."""
