"""Published recordings: where they are and under which terms; fetched, verified, unpacked as `run` takes them."""
