"""The arm's side: playback of commands, the loop around a drive, and one small file an arm."""
