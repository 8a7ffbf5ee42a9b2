"""Topics for RViz: odometry, path, goal, retrieved sub-trajectories and value."""
