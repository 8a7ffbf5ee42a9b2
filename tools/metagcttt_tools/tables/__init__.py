"""Tables of other people as datasets: CSV, parquet and LeRobotDataset v3. No ROS."""
