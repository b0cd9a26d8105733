"""Autonomous flight by the map: perception, planning, supervision, and the API `navigator.Navigator`.

Tested with emulated drones only, not with a real one.
"""
