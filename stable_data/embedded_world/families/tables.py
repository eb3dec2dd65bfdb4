"""Names of the kinds of table that families are usual on."""

COFFEE = "coffee_table"
DINING = "dining_table"
DRESSING = "dressing_table"
KITCHEN = "kitchen_counter"
OFFICE = "office_table"
BATHROOM = "bathroom_vanity"
