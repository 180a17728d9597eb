// Class tables and the rules that give mesh parts their classes.
#include <string>

#include "classes/class_import.h"
#include "datasets/obj_room/class_rules.h"
#include "tests/fuzz/inputs.h"
#include "tests/fuzz/targets.h"

namespace semfield::fuzz {

// The same bytes as every kind of table.
void fuzz_classes(std::string_view bytes) {
  for (const char* name : {"classes.yaml", "classes.csv", "info_semantic.json", "labelmap.txt", "labels.tsv"}) {
    const std::string path = put(name, bytes);
    accepted([&] {
      const ClassTable table = import_classes(path);
      promise(table.valid_count() <= 1024, "more classes than are allowed");
      for (const ClassEntry& entry : table.entries()) {
        promise(entry.id >= 0 && entry.id <= 65535, "an id that no label image can hold");
        promise(table.index_of(entry.id) == (entry.ignore ? kVoid : table.index_of(entry.id)),
                "an ignored class counts");
      }
      const std::string written = put("written.yaml", table.to_yaml());
      ClassTable again;
      promise(table.empty() || accepted([&] { again = ClassTable::load(written); }), "what is written cannot be read");
      promise(again.entries().size() == table.entries().size(), "what is written has other classes");
    });
  }
}

void fuzz_class_rules(std::string_view bytes) {
  const std::string path = put("rules.yaml", bytes);
  accepted([&] {
    const ClassRules rules = load_class_rules(path);
    TriangleMesh mesh;
    mesh.objects = {"chair_1", "wall__north", "lamp.003", ""};
    mesh.groups = {"", "g"};
    mesh.materials.resize(1);
    mesh.materials[0].name = "Glass";
    for (std::int32_t t = 0; t < 4; ++t) {
      mesh.triangles.push_back({0, 0, 0});
      mesh.object_of.push_back(t);
      mesh.group_of.push_back(t % 2);
      mesh.material_of.push_back(t % 2 - 1);
    }
    Diagnostics diagnostics;
    for (const std::int16_t index : classes_of_mesh(mesh, rules, diagnostics))
      promise(index >= kVoid && index < rules.table.valid_count(), "a class that is none");
  });
}

}  // namespace semfield::fuzz
