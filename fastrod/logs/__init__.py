"""What a robot did: run logs, their recording, and the link to a robot, real or simulated."""
