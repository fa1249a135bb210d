"""The simulated soldering bench: scene, scripted hands, a teacher and its demonstrations, and the
physics around the arm.
"""
