"""What a run leaves behind: its folder (`run_writer`), maps in other formats, recorded flights, pictures."""
