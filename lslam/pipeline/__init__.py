"""The recipe: readers to odometry to map to report, and the run folder."""
