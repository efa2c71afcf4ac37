rule mocks:
    input:
        unpack(inputs("mocks")),
    output:
        ensure(output("mocks"), non_empty=True),
    params:
        settings=settings("mocks"),
        inputs=input_words,
    log:
        note("logs", "mocks"),
    benchmark:
        note("benchmarks", "mocks")
    resources:
        mem_mb=1000,
        runtime=60,
        sample_seconds=SAMPLE_SECONDS,
    message:
        "mocks: samples {wildcards.start} to {wildcards.stop}"
    shell:
        command("mocks", TIMED)
