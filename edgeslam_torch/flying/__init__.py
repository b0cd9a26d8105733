"""A drone that flies by its map: what sees, what plans, what watches over both, and `navigator.Navigator` to call.

Only emulated drones have flown by it so far; no real one has.
"""
