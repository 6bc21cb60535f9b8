-- A store as version 2 of its layout wrote it: a scene with an asset, two changes of one gesture and their undo; the
-- token `wall`.
PRAGMA journal_mode=WAL;
CREATE TABLE asset_names (
	digest VARCHAR NOT NULL, 
	name VARCHAR NOT NULL, 
	PRIMARY KEY (digest, name), 
	FOREIGN KEY(digest) REFERENCES assets (digest)
);
INSERT INTO "asset_names" VALUES('a5ef04f55cfb16ec7d18c6e0d264b2237d9e09a529cb69e0174e594f8025eec8','shape.obj');
CREATE TABLE asset_uses (
	digest VARCHAR NOT NULL, 
	scene_id VARCHAR NOT NULL, 
	number INTEGER NOT NULL, 
	PRIMARY KEY (digest, scene_id), 
	FOREIGN KEY(scene_id, number) REFERENCES revisions (scene_id, number)
);
INSERT INTO "asset_uses" VALUES('a5ef04f55cfb16ec7d18c6e0d264b2237d9e09a529cb69e0174e594f8025eec8','aa43a4272f05a016',1);
CREATE TABLE assets (
	digest VARCHAR NOT NULL, 
	kind VARCHAR NOT NULL, 
	format VARCHAR NOT NULL, 
	size_bytes INTEGER NOT NULL, 
	facts VARCHAR NOT NULL, 
	uploaded_ns INTEGER NOT NULL, 
	PRIMARY KEY (digest)
);
INSERT INTO "assets" VALUES('a5ef04f55cfb16ec7d18c6e0d264b2237d9e09a529cb69e0174e594f8025eec8','mesh','obj',64,'{"triangles": 4}',1795486938416545359);
CREATE TABLE choices (
	"key" VARCHAR NOT NULL, 
	value VARCHAR NOT NULL, 
	PRIMARY KEY ("key")
);
INSERT INTO "choices" VALUES('active_scene','aa43a4272f05a016');
CREATE TABLE revisions (
	scene_id VARCHAR NOT NULL, 
	number INTEGER NOT NULL, 
	at_ns INTEGER NOT NULL, 
	what VARCHAR NOT NULL, 
	name VARCHAR NOT NULL, 
	document VARCHAR, 
	origin INTEGER NOT NULL, 
	"before" INTEGER, 
	redo INTEGER, 
	gesture VARCHAR, 
	PRIMARY KEY (scene_id, number), 
	FOREIGN KEY(scene_id) REFERENCES scenes (id)
);
INSERT INTO "revisions" VALUES('aa43a4272f05a016',1,1795486938422885150,'created','first','{"lights":{"environment":{"intensity":1.0,"map":null,"rotation_deg":0.0,"up":[0.0,0.0,1.0]},"fisheye":{"count":4,"distance_m":"auto","smoothing_s":0.5,"split":"peaks","threshold":4.0},"manual":[{"angular_radius_deg":5.0,"color_linear":[1.0,1.0,1.0],"direction":[0.2822162605150792,0.18814417367671948,-0.9407208683835974],"irradiance":1.5,"type":"directional"},{"color_linear":[1.0,1.0,1.0],"radiance":0.2,"type":"ambient"}],"mode":"manual","registration":null,"surroundings":"auto","tracked":[]},"method":{"bounces":1,"caustics":true,"composition":null,"cone_count":16,"cone_scale":null,"coverage":"summed","far_volume":true,"memory_budget_mb":4096,"mirrored_lights":true,"name":"dvct","operator":"exact","quality":"best","radiance":"measured","reflections":"rays","rsm_size":null,"screen_space":true,"shadow":null,"shadow_samples":16,"triangle_budget":null,"volume_edge_m":null,"volume_size":null,"voxels":"directional"},"name":"first","objects":[{"animation":null,"asset":"sha256:a5ef04f55cfb16ec7d18c6e0d264b2237d9e09a529cb69e0174e594f8025eec8","frame":"world","id":"shape","material":null,"pose":{"rotation_wxyz":[1.0,0.0,0.0,0.0],"scale":1.0,"translation_m":[0.0,0.0,0.0]},"rigid":true,"up_axis":null,"visible":true}],"output":{"antialiasing":false,"bloom":0.0,"camera_artifacts":false,"frame_budget_ms":null,"height":null,"tone":"camera","view":"composite","width":null},"real":{"geometry":"depth","surfaces":[],"unseen_albedo":null},"revision":1,"shading":{"name":"auto","occlusion_radius_m":null,"samples":40}}',1,NULL,NULL,NULL);
INSERT INTO "revisions" VALUES('aa43a4272f05a016',2,1795486938431044493,'renamed','second','{"lights":{"environment":{"intensity":1.0,"map":null,"rotation_deg":0.0,"up":[0.0,0.0,1.0]},"fisheye":{"count":4,"distance_m":"auto","smoothing_s":0.5,"split":"peaks","threshold":4.0},"manual":[{"angular_radius_deg":5.0,"color_linear":[1.0,1.0,1.0],"direction":[0.2822162605150792,0.18814417367671948,-0.9407208683835974],"irradiance":1.5,"type":"directional"},{"color_linear":[1.0,1.0,1.0],"radiance":0.2,"type":"ambient"}],"mode":"manual","registration":null,"surroundings":"auto","tracked":[]},"method":{"bounces":1,"caustics":true,"composition":null,"cone_count":16,"cone_scale":null,"coverage":"summed","far_volume":true,"memory_budget_mb":4096,"mirrored_lights":true,"name":"dvct","operator":"exact","quality":"best","radiance":"measured","reflections":"rays","rsm_size":null,"screen_space":true,"shadow":null,"shadow_samples":16,"triangle_budget":null,"volume_edge_m":null,"volume_size":null,"voxels":"directional"},"name":"second","objects":[{"animation":null,"asset":"sha256:a5ef04f55cfb16ec7d18c6e0d264b2237d9e09a529cb69e0174e594f8025eec8","frame":"world","id":"shape","material":null,"pose":{"rotation_wxyz":[1.0,0.0,0.0,0.0],"scale":1.0,"translation_m":[0.0,0.0,0.0]},"rigid":true,"up_axis":null,"visible":true}],"output":{"antialiasing":false,"bloom":0.0,"camera_artifacts":false,"frame_budget_ms":null,"height":null,"tone":"camera","view":"composite","width":null},"real":{"geometry":"depth","surfaces":[],"unseen_albedo":null},"revision":2,"shading":{"name":"auto","occlusion_radius_m":null,"samples":40}}',2,1,NULL,'drag');
INSERT INTO "revisions" VALUES('aa43a4272f05a016',3,1795486938433060779,'renamed','third','{"lights":{"environment":{"intensity":1.0,"map":null,"rotation_deg":0.0,"up":[0.0,0.0,1.0]},"fisheye":{"count":4,"distance_m":"auto","smoothing_s":0.5,"split":"peaks","threshold":4.0},"manual":[{"angular_radius_deg":5.0,"color_linear":[1.0,1.0,1.0],"direction":[0.2822162605150792,0.18814417367671948,-0.9407208683835974],"irradiance":1.5,"type":"directional"},{"color_linear":[1.0,1.0,1.0],"radiance":0.2,"type":"ambient"}],"mode":"manual","registration":null,"surroundings":"auto","tracked":[]},"method":{"bounces":1,"caustics":true,"composition":null,"cone_count":16,"cone_scale":null,"coverage":"summed","far_volume":true,"memory_budget_mb":4096,"mirrored_lights":true,"name":"dvct","operator":"exact","quality":"best","radiance":"measured","reflections":"rays","rsm_size":null,"screen_space":true,"shadow":null,"shadow_samples":16,"triangle_budget":null,"volume_edge_m":null,"volume_size":null,"voxels":"directional"},"name":"third","objects":[{"animation":null,"asset":"sha256:a5ef04f55cfb16ec7d18c6e0d264b2237d9e09a529cb69e0174e594f8025eec8","frame":"world","id":"shape","material":null,"pose":{"rotation_wxyz":[1.0,0.0,0.0,0.0],"scale":1.0,"translation_m":[0.0,0.0,0.0]},"rigid":true,"up_axis":null,"visible":true}],"output":{"antialiasing":false,"bloom":0.0,"camera_artifacts":false,"frame_budget_ms":null,"height":null,"tone":"camera","view":"composite","width":null},"real":{"geometry":"depth","surfaces":[],"unseen_albedo":null},"revision":3,"shading":{"name":"auto","occlusion_radius_m":null,"samples":40}}',3,1,NULL,'drag');
INSERT INTO "revisions" VALUES('aa43a4272f05a016',4,1795486938435086639,'undo','first',NULL,1,NULL,3,NULL);
CREATE TABLE scenes (
	id VARCHAR NOT NULL, 
	created_ns INTEGER NOT NULL, 
	deleted_ns INTEGER, 
	PRIMARY KEY (id)
);
INSERT INTO "scenes" VALUES('aa43a4272f05a016',1795486938422309692,NULL);
CREATE TABLE tokens (
	id VARCHAR NOT NULL, 
	name VARCHAR NOT NULL, 
	role VARCHAR NOT NULL, 
	salt BLOB NOT NULL, 
	hash BLOB NOT NULL, 
	created_ns INTEGER NOT NULL, 
	PRIMARY KEY (id), 
	UNIQUE (name)
);
INSERT INTO "tokens" VALUES('fa9ac659b290','wall','view',X'E7A6053DA1F60FF99D2161025251CECE',X'3CFF5DB8398D123BC233D675B12ED3FA57EF3D09DC15B07531D46132FEDA5220',1795486938436994864);
CREATE INDEX ix_asset_names_name ON asset_names (name);
PRAGMA user_version=2;
