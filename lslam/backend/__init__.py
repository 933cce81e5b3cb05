"""The back end: a run's keyframes, loops, fixes, gravity and floors put into the pose graph, and all scans placed by it."""
