"""What any training needs, whatever its algorithm is. The algorithms are in ppo_gru.py and ppo_trxl.py.

    flags          types of flags with bounds, presets, parsing, checks
    environments   any Gymnasium id, ready to train on
    observations   observations as pictures and vectors
    wrappers       what can be observed beside them: stacks, the step, the last action
    video          videos of the first environment
    evaluation     scores on levels that are not trained on
    runs           a training from its first file to its last line: folder, logs, signals
    checkpoints    models and checkpoints: written, read, resumed
    processes      several processes that train one agent
    fast           what computes the same faster on a CPU

No module here imports a script: what is needed of one (an agent, its arguments) is handed over.
"""
