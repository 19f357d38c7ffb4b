"""Wide-angle and fisheye images for vision transformers, fast on CPUs."""
