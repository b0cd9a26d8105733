"""Obstruction of the flight: contact with unseen obstacles, and places of repeated tracking loss."""
