"""The commands of the workbench, one file a group."""
