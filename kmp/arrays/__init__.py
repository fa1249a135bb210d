"""Arrays that enter and leave the package, checked and read-only; small linear algebra."""
