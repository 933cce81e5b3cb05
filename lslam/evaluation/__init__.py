"""How good is a trajectory: ATE, RPE, KITTI drift and the two theses' numbers, each beside its recipe."""
