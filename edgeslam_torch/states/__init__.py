"""What the system is doing, and what a frame makes of it: `machine.py` has the whole table of states and events.

Every state turns a frame into a `Step` and names the event that it met: `starting.py` follows guessed depths until a
map stands, `tracking.py` finds frames in the map and makes keyframes, `lost.py` searches and at last starts anew. What
they share (map, motion, metres, mapping) is `system.py`.
"""
