"""Requests and answers, independent of the transport."""
