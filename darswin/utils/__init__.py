"""What has nothing to do with lenses: files, memory, reading an image."""
