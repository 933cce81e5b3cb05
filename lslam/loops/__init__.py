"""Places seen before: candidates, verification, loop closures."""
