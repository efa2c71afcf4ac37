# What a campaign consists of, for who publishes it: last of all, and anew when one of its files or the configuration is.
rule manifest:
    input:
        list(ARTIFACTS),
        [path for path in derived_files(CAMPAIGN) if path.name != CONFIG],  # written anew at every start
    output:
        manifest=ensure(results(MANIFEST), non_empty=True),
        crate=ensure(results(CRATE), non_empty=True),
    params:
        version=MANIFEST_VERSION,
        config=settings_digest(CAMPAIGN.model_dump(mode="json")),
        folder=CAMPAIGN.results,
    log:
        results("logs/manifest.log"),
    benchmark:
        results("benchmarks/manifest.tsv")
    resources:
        mem_mb=1000,
        runtime=20,
    message:
        "manifest: sizes and digests of all files"
    shell:
        "warmlens manifest {params.folder:q} > {log:q} 2>&1"
