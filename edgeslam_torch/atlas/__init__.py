"""Merging of submaps (pieces of map) and loop closure.

`place_recognition.py` proposes keyframes, `links.py` verifies that a keyframe shows another submap and estimates the
similarity between the two, `map_merging.py` moves the smaller submap and merges both, and `atlas.py` decides: two links
must agree.
"""
