"""Models for inference: made faster, and exported as graphs."""
