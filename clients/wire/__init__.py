"""What is sent and received, whatever the transport."""
