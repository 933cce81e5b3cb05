"""What every room needs and no file of it is about LiDAR: cores and locks, paths in storage, stops, texts, untrusted input."""
