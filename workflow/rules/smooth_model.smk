rule smooth_model:
    input:
        unpack(inputs("smooth_model")),
    output:
        ensure(output("smooth_model"), non_empty=True),
    params:
        settings=settings("smooth_model"),
        inputs=input_words,
    log:
        note("logs", "smooth_model"),
    benchmark:
        note("benchmarks", "smooth_model")
    resources:
        mem_mb=3000,
        runtime=30,
    message:
        "smooth model: fit source, light and quasars"
    shell:
        command("smooth_model")
