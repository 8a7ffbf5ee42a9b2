"""The simulator bridge: publishes states and steps the simulator with the actions received."""
