"""Recipes of weights that come with the package, beside `default_weights`."""
