"""Processing of one recording, from readers to odometry, map and report; and the run folder."""
