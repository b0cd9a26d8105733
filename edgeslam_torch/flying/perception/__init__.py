"""What a pilot is told of pictures and state messages, in metres and in a world of its own."""
