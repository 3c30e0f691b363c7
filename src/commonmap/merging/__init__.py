"""Fuse octrees, clouds and height maps that share a frame."""
