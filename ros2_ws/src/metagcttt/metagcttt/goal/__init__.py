"""Goals on the graph: checks them, numbers them and decides when they are over."""
