-- A store as version 1 of its layout wrote it: one scene, whose second revision changed its name.
PRAGMA journal_mode=WAL;
CREATE TABLE assets (digest VARCHAR NOT NULL, kind VARCHAR NOT NULL, format VARCHAR NOT NULL, size_bytes INTEGER NOT NULL, facts VARCHAR NOT NULL, uploaded_ns INTEGER NOT NULL, PRIMARY KEY (digest));
CREATE TABLE choices ("key" VARCHAR NOT NULL, value VARCHAR NOT NULL, PRIMARY KEY ("key"));
CREATE TABLE scenes (id VARCHAR NOT NULL, created_ns INTEGER NOT NULL, deleted_ns INTEGER, PRIMARY KEY (id));
CREATE TABLE tokens (id VARCHAR NOT NULL, name VARCHAR NOT NULL, role VARCHAR NOT NULL, salt BLOB NOT NULL, hash BLOB NOT NULL, created_ns INTEGER NOT NULL, PRIMARY KEY (id), UNIQUE (name));
CREATE TABLE asset_names (digest VARCHAR NOT NULL, name VARCHAR NOT NULL, PRIMARY KEY (digest, name), FOREIGN KEY(digest) REFERENCES assets (digest));
CREATE INDEX ix_asset_names_name ON asset_names (name);
CREATE TABLE revisions (scene_id VARCHAR NOT NULL, number INTEGER NOT NULL, at_ns INTEGER NOT NULL, what VARCHAR NOT NULL, name VARCHAR NOT NULL, document VARCHAR, origin INTEGER NOT NULL, "before" INTEGER, redo INTEGER, PRIMARY KEY (scene_id, number), FOREIGN KEY(scene_id) REFERENCES scenes (id));
CREATE TABLE asset_uses (digest VARCHAR NOT NULL, scene_id VARCHAR NOT NULL, number INTEGER NOT NULL, PRIMARY KEY (digest, scene_id), FOREIGN KEY(scene_id, number) REFERENCES revisions (scene_id, number));
INSERT INTO scenes VALUES ('4f0c2a9be1d37785', 1763700000000000000, NULL);
INSERT INTO revisions VALUES ('4f0c2a9be1d37785', 1, 1763700000000000000, 'created', 'old', '{"name": "old"}', 1, NULL, NULL);
INSERT INTO revisions VALUES ('4f0c2a9be1d37785', 2, 1763700001000000000, 'name changed', 'new', '{"name": "new"}', 2, 1, NULL);
INSERT INTO choices VALUES ('active_scene', '4f0c2a9be1d37785');
PRAGMA user_version=1;
