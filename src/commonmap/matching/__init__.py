"""What "similar" means at every pose, the search, the refinement and the verdict."""
