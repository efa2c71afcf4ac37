# In place of `abc` where the samples are the nodes of a grid.
rule exclusion:
    input:
        unpack(inputs("exclusion")),
    output:
        artifact=ensure(output("exclusion"), non_empty=True),
        beside=ensure([results(name) for name in ANSWER_FILES["exclusion"]], non_empty=True),
    params:
        settings=settings("exclusion"),
        inputs=input_words,
    log:
        note("logs", "exclusion"),
    benchmark:
        note("benchmarks", "exclusion")
    resources:
        mem_mb=answer_memory_mb(CAMPAIGN),
        runtime=30,
    message:
        "exclusion: accept samples, count them on the nodes"
    shell:
        command("exclusion")
