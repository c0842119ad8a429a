"""What the images are made of: locked versions with hashes, licences, parts lists."""
