"""What keeps a drone from its way: something that holds it, and places where its pose is lost."""
