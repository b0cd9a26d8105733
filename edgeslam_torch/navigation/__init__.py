"""Flying by the map: free space, routes through it, and what watches over a flight.

Nothing here knows a drone or an emulator: records come in (`state.py`), wanted velocities go out (`pilot.py`).
"""
