"""Exploration: frontiers, coverage by the camera, and second looks at candidate openings."""
