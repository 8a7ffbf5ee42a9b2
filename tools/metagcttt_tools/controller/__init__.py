"""Training of the controllers that walk a robot along a direction."""
