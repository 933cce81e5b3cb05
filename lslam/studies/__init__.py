"""Studies over many runs: a grid of jobs, a process for each, and what is collected from their folders."""
