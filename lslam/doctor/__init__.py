"""The doctor: what is wrong with a recording, found before a run asks too much of it."""
