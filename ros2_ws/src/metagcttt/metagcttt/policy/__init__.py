"""The policy node: filters the dataset, adapts for K steps per goal and acts."""
