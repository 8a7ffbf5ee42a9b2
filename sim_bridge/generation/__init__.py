"""Generation of offline datasets: plan, behaviour policies, episodes, resumable chunks."""
