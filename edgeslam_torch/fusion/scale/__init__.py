"""Metres per map unit: what each source says, how sure it is, and which of them count."""
