"""`darswin bench`: how fast a whole model is on this machine, beside what else one could run."""
