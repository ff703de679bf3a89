"""What tests of P-DVC start from: small cases, and hypothesis strategies."""
