//! End-to-end tests: cells of real processes, asked as users ask them.
