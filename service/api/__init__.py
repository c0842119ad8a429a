"""Between the words of the API and the values of the engine: requests in, answers out."""
