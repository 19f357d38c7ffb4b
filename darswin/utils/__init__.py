"""Helpers without lenses: files, memory, processes, progress, images and videos."""
