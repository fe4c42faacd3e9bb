"""What any training needs, whatever its algorithm is. The algorithms are in ppo_gru.py and ppo_trxl.py.

    flags          types of flags with bounds, their spelling, checks
    environments   any Gymnasium id, ready to train on
    lanes          environments side by side, each with seeds and errors of its own
    observations   observations as images and vectors
    wrappers       what can be observed too: stacks, the step, the last action, Fourier features, spotlights
    video          videos of the first environment
    infos          what a training counts and logs of their infos
    evaluation     scores on levels that are not trained on
    moments        running moments, and the scale of rewards that is made of them
    scores         interquartile means and their table; which runs are seeds of one agent
    run_logs       what runs have logged, read again
    curves         pictures and tables of that
    memory_check   what is wrong with the memory of an agent, whoever made it
    memory_adapters, memory_probes   such agents, and environments for those that can only be trained
    acting         a trained agent in a program of one's own
    run            what a training run consists of
    runs           a training from its command line to its end: run folder, signals
    logs           TensorBoard, progress bar, Weights and Biases
    checkpoints    models and checkpoints: written, read, resumed
    processes      several processes that train one agent
    errors         what ends a training, in one line
    terminal       where programs write to, which may be closed or gone
    fast           what computes the same faster on a CPU

`checkpoints.import_script` imports the script that wrote a file.
"""
