"""The offline job: ``mapping build | inspect | verify | export-features | sample``."""
