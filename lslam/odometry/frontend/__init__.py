"""The front end: scans read ahead, tracked one by one and made keyframes, from an IMU's start or a checkpoint on."""
