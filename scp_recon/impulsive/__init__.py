"""Problems by hand: impulsive transfers of any flow, planned and flown as missions are."""
