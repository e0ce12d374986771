"""What estimates the flow of a pair, behind one interface: this project's networks, RAFT's, and "fast"."""
