"""Exits and pathways: what the free space around a drone leads to."""
