"""What any training needs, whatever its algorithm is. The algorithms are in ppo_gru.py and ppo_trxl.py.

    flags          types of flags with bounds, their spelling, checks
    environments   any Gymnasium id, ready to train on
    lanes          environments side by side, each with seeds and errors of its own
    observations   observations as images and vectors
    wrappers       what can be observed too: stacks, the step, the last action, Fourier features, spotlights
    video          videos of the first environment
    evaluation     scores on levels that are not trained on
    acting         a trained agent in a program of one's own
    runs           run folder, logs, progress bar, signals, command line
    checkpoints    models and checkpoints: written, read, resumed
    processes      several processes that train one agent
    fast           what computes the same faster on a CPU

No module here names a script; `checkpoints.import_script` imports the one that wrote a file.
"""
