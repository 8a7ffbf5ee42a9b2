"""The policy on the graph: filters, adapts for K steps per goal and acts."""
