"""Navigation by the map: free space, path planning, skills and the supervisor of a flight.

Independent of any drone or emulator: `drone_state.py` defines the input, `pilot.py` computes velocity commands.
"""
