"""What happens when a registration from the motion prior is not enough: one policy a class."""
