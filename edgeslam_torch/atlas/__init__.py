"""Submaps: how they lie relative to each other, recognition of places, merging, loop closure, and storage.

`submap_graph.py` states the relation of two places by sensors and by the map, with a covariance;
`place_recognition.py` proposes keyframes that may show one place; `links.py` verifies that by images. `atlas.py`
decides: two links that agree with each other and with the graph merge two submaps or close a loop; `relaxation.py`
then moves the map. `saved.py` and `atlas_file.py` store it.
"""
