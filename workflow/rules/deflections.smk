rule deflections:
    input:
        unpack(inputs("deflections")),
    output:
        ensure(output("deflections"), non_empty=True),
    params:
        settings=settings("deflections"),
        inputs=input_words,
    log:
        note("logs", "deflections"),
    benchmark:
        note("benchmarks", "deflections")
    resources:
        mem_mb=1000,
        runtime=60,
        sample_seconds=SAMPLE_SECONDS,
    message:
        "deflections: samples {wildcards.start} to {wildcards.stop}"
    shell:
        command("deflections", TIMED)
