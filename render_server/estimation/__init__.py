"""What has to be found from pictures: the lights' common factor, light from out of sight, albedo."""
