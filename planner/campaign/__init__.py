"""The paper's evaluation (section 5.3, Fig. 9) as a campaign of many searches, with verdicts."""
