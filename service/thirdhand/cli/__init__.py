"""The commands of `thirdhand`, one file a group."""
