"""Rooms: furniture, scenes, and their exact rendering."""
