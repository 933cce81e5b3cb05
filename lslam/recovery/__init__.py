"""Recovery policies of registrations that fail from the motion prior: one policy a class."""
