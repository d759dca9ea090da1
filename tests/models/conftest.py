"""For the tests in the folders below, which import the modules beside this file (`moving`, `surroundings`)."""
