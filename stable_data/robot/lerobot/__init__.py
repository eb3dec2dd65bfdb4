"""Episodes as a LeRobotDataset v3.0, written without lerobot."""
