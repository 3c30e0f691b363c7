"""Simulated worlds, lidars and missions, with exact truth."""
