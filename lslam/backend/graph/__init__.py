"""The pose graph: what odometry, loops, satellites, gravity and the floor say of keyframes, made one. Only here: gtsam."""
