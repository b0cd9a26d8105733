"""Descriptions of the commands for the command line."""
