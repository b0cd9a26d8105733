"""Rigid motion, cameras, epipolar geometry and triangulation."""
