// From names to classes by rules and prefixes, what is said where they do not fit, and camera paths through a room.
#include <algorithm>

#include "datasets/obj_room/obj_room.h"
#include "datasets/obj_room/tests/obj_testing.h"

namespace semfield {
namespace {

using namespace testing_obj;

const std::string kClasses =
    "classes:\n"
    "  - {id: 0, name: void, ignore: true}\n"
    "  - {id: 3, name: chair}\n"
    "  - {id: 5, name: window}\n"
    "  - {id: 9, name: dining_table}\n";

ClassRules rules_of(const std::string& text, const std::string& name = "classes.yaml") {
  const std::string path = fresh_folder("rules") + "/" + name;
  plain_write(path, text);
  return load_class_rules(path);
}

struct Part {
  std::string object, group, material;
};

// One triangle a part.
TriangleMesh mesh_of(const std::vector<Part>& parts) {
  TriangleMesh mesh;
  const auto index = [](std::vector<std::string>& names, const std::string& name) {
    const auto it = std::find(names.begin(), names.end(), name);
    if (it != names.end()) return static_cast<std::int32_t>(it - names.begin());
    names.push_back(name);
    return static_cast<std::int32_t>(names.size() - 1);
  };
  std::vector<std::string> materials;
  for (const Part& part : parts) {
    mesh.triangles.push_back({0, 1, 2});
    mesh.object_of.push_back(index(mesh.objects, part.object));
    mesh.group_of.push_back(index(mesh.groups, part.group));
    mesh.material_of.push_back(part.material.empty() ? -1 : index(materials, part.material));
  }
  for (const std::string& name : materials) {
    mesh.materials.emplace_back();
    mesh.materials.back().name = name;
  }
  return mesh;
}

std::vector<std::int16_t> classes(const std::vector<Part>& parts, const ClassRules& rules) {
  Diagnostics d;
  const std::vector<std::int16_t> out = classes_of_mesh(mesh_of(parts), rules, d);
  EXPECT_EQ(texts(d), std::vector<std::string>{});
  return out;
}

TEST(ClassRules, GlobsMatchWholeNames) {
  EXPECT_TRUE(matches_glob("chair_12", "chair_*"));
  EXPECT_TRUE(matches_glob("chair_", "chair_*"));
  EXPECT_FALSE(matches_glob("armchair_1", "chair_*"));
  EXPECT_TRUE(matches_glob("armchair_1", "*chair*"));
  EXPECT_TRUE(matches_glob("a_b_c_b", "a*b"));
  EXPECT_FALSE(matches_glob("a_b_c", "a*b"));
  EXPECT_TRUE(matches_glob("leg3", "leg?"));
  EXPECT_FALSE(matches_glob("leg", "leg?"));
  EXPECT_FALSE(matches_glob("leg33", "leg?"));
  EXPECT_TRUE(matches_glob("", "*"));
  EXPECT_FALSE(matches_glob("Chair", "chair"));
  EXPECT_TRUE(matches_glob("a*b", "a*b"));
  EXPECT_TRUE(matches_glob(std::string(60, 'a'), "*a*a*a*a*a*a*a*a"));
  EXPECT_FALSE(matches_glob(std::string(60, 'a'), "*a*a*a*a*a*a*a*a*b"));
}

TEST(ClassRules, RulesByObjectGroupAndMaterialTheEarlierWins) {
  const ClassRules rules = rules_of(kClasses +
                                    "rules:\n"
                                    "  - {object: \"thing_*\", material: Glass, class: window}\n"
                                    "  - {object: \"thing_?\", class: chair}\n"
                                    "  - {group: \"legs*\", class: dining_table}\n"
                                    "  - {material: \"Dust*\", class: void}\n"
                                    "  - {object: \"*\", material: Glass, class: chair}\n");
  EXPECT_EQ(rules.rules.size(), 5u);
  EXPECT_EQ(classes({{"thing_1", "", "Glass"},
                     {"thing_1", "", "Wood"},
                     {"Mesh7", "legs_2", "Wood"},
                     {"Mesh7", "", "Dusty"},
                     {"Mesh7", "", "Glass"}},
                    rules),
            (std::vector<std::int16_t>{1, 0, 2, kVoid, 0}));
}

TEST(ClassRules, ObjectNamesDecideWithoutARule) {
  const ClassRules rules = rules_of(kClasses);
  EXPECT_EQ(classes({{"chair", "", ""},
                     {"chair__Mesh037_Wood", "", ""},
                     {"chair_12", "", ""},
                     {"window.003", "", ""},
                     {"dining_table_2", "", ""},
                     {"void_1", "", ""}},
                    rules),
            (std::vector<std::int16_t>{0, 0, 0, 1, 2, kVoid}));
}

TEST(ClassRules, EveryObjectWithoutAClassIsReportedInOnePass) {
  const ClassRules rules = rules_of(kClasses);
  const TriangleMesh mesh = mesh_of({{"chair_1", "", ""},
                                     {"stool_1", "", ""},
                                     {"stool_1", "seat", "Wood"},
                                     {"Chair_1", "", "Oak"},
                                     {"chairs_1", "row", ""},
                                     {"chair12", "", ""}});
  Diagnostics d;
  const std::vector<std::int16_t> out = classes_of_mesh(mesh, rules, d);
  EXPECT_EQ(out, (std::vector<std::int16_t>{0, kVoid, kVoid, kVoid, kVoid, kVoid}));
  const auto remedy = [](const std::string& name) {
    return "; add a rule such as {object: \"" + name + "\", class: NAME} to the class table";
  };
  EXPECT_EQ(texts(d),
            (std::vector<std::string>{"error|object 'stool_1': has no class" + remedy("stool_1"),
                                      "error|object 'Chair_1': has no class (material 'Oak')" + remedy("Chair_1"),
                                      "error|object 'chairs_1': has no class (group 'row')" + remedy("chairs_1"),
                                      "error|object 'chair12': has no class" + remedy("chair12")}));
}

TEST(ClassRules, TablesWithoutRulesReadToo) {
  EXPECT_EQ(rules_of("class_id,class\n0,void\n1,chair\n", "classes.csv").table.valid_count(), 1);
  const ClassRules list = rules_of("- {id: 1, name: chair}\n- {id: 2, name: table}\n");
  EXPECT_EQ(list.table.valid_count(), 2);
  EXPECT_TRUE(list.rules.empty());
}

TEST(ClassRules, EveryFaultOfATableIsNamedWithItsPlace) {
  const std::string path = fresh_folder("bad") + "/classes.yaml";
  const auto message = [&](const std::string& text) {
    plain_write(path, text);
    return error_of([&] { load_class_rules(path); });
  };
  const std::string head = "the class table '" + path + "' has errors\n";
  EXPECT_EQ(message(kClasses + "rules:\n"
                               "  - {object: \"a*\", class: chiar}\n"
                               "  - {objekt: \"a*\", class: chair}\n"
                               "  - {object: b}\n"
                               "  - {class: window}\n"
                               "  - lamp\n"),
            head + path + ":7:27: no class named 'chiar'; did you mean 'chair'?\n" + path +
                ":8:14: unknown key 'objekt' in a rule; did you mean 'object'?\n" + path +
                ":8:5: the rule asks for no object, group or material; add object: \"PATTERN\" (and 1 more like this: "
                "classes.yaml:10:5)\n" +
                path + ":9:5: the rule names no class; add class: NAME\n" + path +
                ":11:5: a rule is a map such as {object: \"chair_*\", class: chair}");
  EXPECT_EQ(message(kClasses + "rules: {object: a, class: chair}\n"), head + path + ":6:8: 'rules' is a list of rules");
  // An unknown key hides neither the table's faults nor those of the rules.
  EXPECT_EQ(message(kClasses + "extra: 1\nrules:\n  - {object: b}\n"),
            head + path + ":6:8: unknown key 'extra'; known: classes, rules\n" + path +
                ":8:5: the rule names no class; add class: NAME");
  EXPECT_EQ(message("extra: 1\nclasses:\n  - {id: one, name: chair}\n"),
            head + path + ":1:8: unknown key 'extra'; known: classes, rules\n" + path +
                ":3:10: id: expected an integer from 0 to 65535, got 'one'");
  EXPECT_EQ(message("classes:\n  - {id: 1, name: a}\n  - {id: 1, name: b}\n"),
            path + ": class id 1 is given twice ('a' and 'b'); keep one of them");
  EXPECT_EQ(message("rules:\n  - {object: a, class: b}\n"),
            path + ": expected a list of classes {id, name, color, ignore}; write lines such as - {id: 3, name: lamp}");
  EXPECT_EQ(message("classes:\n  - {id: 1}\n"),
            path + ":2:5: class 1 needs a 'name'; write lines such as - {id: 3, name: lamp}");
  EXPECT_HAS(message("classes: [\n"), path);
}

TEST(ClassRules, MissingTableIsNoInput) {
  for (const char* name : {"/none.yaml", "/none.csv"}) {
    const std::string path = fresh_folder("none") + name;
    EXPECT_HAS(error_of(ErrorKind::no_input, [&] { load_class_rules(path); }), path) << path;
  }
}

// What a generated camera path promises.

// A 6 x 5 x 2.75 m room with pillars: free space has corners to cut.
TriangleMesh pillars() {
  std::ostringstream obj;
  int vertices = 0;
  const std::array<const char*, 6> wall{"wall_1", "wall_2", "wall_3", "wall_4", "floor_1", "ceiling_1"};
  const std::array<const char*, 6> pillar{"pillar_1", "pillar_2", "pillar_3", "pillar_4", "pillar_5", "pillar_6"};
  add_box(obj, {{-3, -2.5, 0}, {3, 2.5, 2.75}}, wall, vertices);
  for (const double x : {-1.5, 0.0, 1.5}) {
    for (const double y : {-0.75, 0.75})
      add_box(obj, {{x - 0.125, y - 0.125, 0}, {x + 0.125, y + 0.125, 2.75}}, pillar, vertices);
  }
  Diagnostics d;
  return load_text(obj.str(), d);
}

PathSettings settings_of(const TriangleMesh& mesh, int poses, std::uint64_t seed) {
  return PathSettings{.poses = poses, .seed = seed, .region = mesh.bounds};
}

bool same(const Pose& a, const Pose& b) { return a.r == b.r && a.t == b.t; }

TEST(RoomPath, EveryPoseIsFreeLevelAndARotation) {
  const TriangleMesh mesh = pillars();
  const Raycaster rays(mesh);
  for (std::uint64_t seed = 0; seed < 6; ++seed) {
    const PathSettings s = settings_of(mesh, 120, seed);
    const std::vector<Pose> path = make_camera_path(rays, s);
    ASSERT_EQ(path.size(), 120u);
    for (std::size_t i = 0; i < path.size(); ++i) {
      const Pose& p = path[i];
      EXPECT_GE(rays.clearance(p.t, 10), s.clearance_m) << "seed " << seed << " pose " << i;
      EXPECT_GE(p.t.z, s.lowest_m - 0.2);
      EXPECT_LE(p.t.z, s.highest_m + 0.2);
      EXPECT_NEAR(p.r[2][0], 0, 1e-12) << "the camera's x axis is not level";
      EXPECT_LT(p.r[2][1], 0) << "the camera's y axis points up";
      for (int a = 0; a < 3; ++a) {
        for (int b = 0; b < 3; ++b) EXPECT_NEAR(dot(p.axis(a), p.axis(b)), a == b ? 1 : 0, 1e-12);
      }
      EXPECT_NEAR(dot(cross(p.axis(0), p.axis(1)), p.axis(2)), 1, 1e-12);
      EXPECT_FALSE(i > 0 && same(p, path[i - 1])) << "seed " << seed << " pose " << i << " repeats the one before";
    }
  }
}

TEST(RoomPath, ClearanceHoldsBesideThinPoles) {
  // Poles thinner than the steps in which a way is tried.
  std::ostringstream obj;
  int vertices = 0;
  const std::array<const char*, 6> names{"a", "b", "c", "d", "e", "f"};
  add_box(obj, {{-1.5, -1.5, 0}, {1.5, 1.5, 2.5}}, names, vertices);
  for (int i = 0; i < 49; ++i) {
    const double x = 0.375 * (i % 7 - 3), y = 0.375 * (i / 7 - 3);
    add_box(obj, {{x, y, 0}, {x + 0.0078125, y + 0.0078125, 2.5}}, names, vertices);
  }
  Diagnostics d;
  const TriangleMesh mesh = load_text(obj.str(), d);
  const Raycaster rays(mesh);
  for (std::uint64_t seed = 80; seed < 112; ++seed) {
    PathSettings s = settings_of(mesh, 120, seed);
    s.clearance_m = 0.03;
    for (const Pose& p : make_camera_path(rays, s))
      EXPECT_GE(rays.clearance(p.t, 10), s.clearance_m) << "seed " << seed;
  }
}

TEST(RoomPath, TheWayBetweenPosesDoesNotPassThroughSurfaces) {
  const TriangleMesh mesh = pillars();
  const Raycaster rays(mesh);
  const std::vector<Pose> path = make_camera_path(rays, settings_of(mesh, 200, 11));
  int through = 0;
  for (std::size_t i = 1; i < path.size(); ++i) {
    const Vec3d way = path[i].t - path[i - 1].t;
    const double far = length(way);
    if (far > 0 && rays.blocked(path[i - 1].t, way * (1 / far), far)) ++through;
  }
  EXPECT_EQ(through, 0);
}

TEST(RoomPath, SeedDecides) {
  const TriangleMesh mesh = pillars();
  const Raycaster rays(mesh);
  const std::vector<Pose> a = make_camera_path(rays, settings_of(mesh, 24, 5)),
                          b = make_camera_path(rays, settings_of(mesh, 24, 5)),
                          c = make_camera_path(rays, settings_of(mesh, 24, 6));
  int equal = 0, other = 0;
  for (std::size_t i = 0; i < 24; ++i) {
    equal += same(a[i], b[i]) ? 1 : 0;
    other += same(a[i], c[i]) ? 1 : 0;
  }
  EXPECT_EQ(equal, 24);
  EXPECT_EQ(other, 0);
}

TEST(RoomPath, UpMayBeY) {
  Diagnostics d;
  std::ostringstream obj;
  int vertices = 0;
  add_box(obj, {{-2, 0, -1.5}, {2, 2.5, 1.5}}, {"a", "b", "c", "d", "e", "f"}, vertices);
  const TriangleMesh mesh = load_text(obj.str(), d);
  const Raycaster rays(mesh);
  PathSettings s = settings_of(mesh, 16, 1);
  s.up = {0, 1, 0};
  for (const Pose& p : make_camera_path(rays, s)) {
    EXPECT_NEAR(p.r[1][0], 0, 1e-12);
    EXPECT_LT(p.r[1][1], 0);
    EXPECT_GE(p.t.y, 0.7);
    EXPECT_GE(rays.clearance(p.t, 10), s.clearance_m);
  }
}

TEST(RoomPath, NoFreeSpaceIsAnError) {
  const TriangleMesh mesh = pillars();
  const Raycaster rays(mesh);
  PathSettings s = settings_of(mesh, 4, 1);
  s.clearance_m = 2;
  const std::string remedy = "; lower scene.clearance_m or set scene.bounds to the inside of the room";
  EXPECT_EQ(error_of([&] { make_camera_path(rays, s); }),
            "no free space for cameras: 0 of 4000 positions are free" + remedy);
  // Outside there is space, but no room around it.
  s = settings_of(mesh, 4, 1);
  s.region = {{10, 10, 0}, {14, 14, 3}};
  EXPECT_EQ(error_of([&] { make_camera_path(rays, s); }),
            "no free space for cameras: 0 of 4000 positions are free" + remedy);
}

}  // namespace
}  // namespace semfield
