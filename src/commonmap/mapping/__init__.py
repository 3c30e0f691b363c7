"""Scans and clouds into octrees, ground surfaces, height maps and slabs."""
