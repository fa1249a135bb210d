"""The soldering bench in simulation: scene, scripted hands, a teacher and its demonstrations, and
the physics around the arm.
"""
