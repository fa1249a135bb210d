"""What measures the loop: beside an empty loop, under loads, for days."""
