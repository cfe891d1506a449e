"""What several test files share: clients, benches, fake peers, packet makers."""
