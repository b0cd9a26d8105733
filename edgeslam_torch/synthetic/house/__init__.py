"""Textured rooms: materials, furniture, scenes, and their exact rendering."""
