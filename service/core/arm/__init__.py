"""Stage 6: the arm's kinematics, and the joint velocities that follow the setpoint."""
