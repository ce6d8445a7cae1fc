"""Speed of environments and filters beside reference libraries, and accuracy targets of the agents."""
