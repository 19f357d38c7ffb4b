"""Helpers without lenses: files, memory, processes, reading images and videos."""
