"""The virtual environment: a city, a path, a LiDAR, exact ground truth."""
