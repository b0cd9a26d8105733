"""What the command line says of its commands."""
