"""Cases that the numbers of counting are fitted on."""
