// Class tables of other tools.
#include "classes/class_import.h"

#include <gtest/gtest.h>

#include "classes/class_names.h"
#include "system/files.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using testing_room::error_of;
using testing_room::fresh_folder;
using Color = std::array<std::uint8_t, 3>;

TEST(PublishedClasses, TablesAndTheMapBetweenThem) {
  const ClassTable nyu40 = published_classes("nyu40"), nyu13 = published_classes("nyu13"),
                   scannet = published_classes("scannet20");
  EXPECT_EQ(nyu40.valid_count(), 40);
  EXPECT_EQ(nyu13.valid_count(), 13);
  EXPECT_EQ(scannet.valid_count(), 20);
  for (const ClassTable* table : {&nyu40, &nyu13, &scannet}) EXPECT_EQ(table->index_of(0), kVoid);
  EXPECT_EQ(nyu40.valid(4).name, "chair");
  EXPECT_EQ(nyu40.valid(39).name, "otherprop");
  EXPECT_EQ(nyu13.valid(3).name, "chair");
  EXPECT_EQ(scannet.index_of(39), 19);
  EXPECT_EQ(scannet.valid(19).name, "otherfurniture");
  EXPECT_EQ(scannet.index_of(13), -2);
  // Names that both have must be mapped to each other.
  const ClassNames names(nyu13);
  for (int c = 0; c < nyu40.valid_count(); ++c) {
    const int same = names.find(nyu40.valid(c).name);
    const std::int32_t mapped = nyu13_of_nyu40(nyu40.valid(c).id);
    EXPECT_GE(nyu13.index_of(mapped), 0);
    if (same >= 0) {
      EXPECT_EQ(nyu13.index_of(mapped), same) << nyu40.valid(c).name;
    }
  }
  EXPECT_EQ(nyu13_of_nyu40(25), 11);
  EXPECT_EQ(nyu13_of_nyu40(0), 0);
  EXPECT_EQ(error_of([] { (void)nyu13_of_nyu40(41); }), "NYU40 id 41; NYU40 ids run from 0 to 40");
  EXPECT_EQ(error_of([] { (void)published_classes("nyu"); }),
            "no published class table 'nyu'; there are nyu13, nyu40, scannet20");
}

TEST(PublishedClasses, PascalColours) {
  EXPECT_EQ(pascal_color(0), (Color{0, 0, 0}));
  EXPECT_EQ(pascal_color(1), (Color{128, 0, 0}));
  EXPECT_EQ(pascal_color(2), (Color{0, 128, 0}));
  EXPECT_EQ(pascal_color(7), (Color{128, 128, 128}));
  EXPECT_EQ(pascal_color(8), (Color{64, 0, 0}));
  EXPECT_EQ(pascal_color(20), (Color{0, 64, 128}));
  EXPECT_EQ(pascal_color(255), (Color{224, 224, 192}));
}

TEST(CvatLabelmap, RoundTripAndRefusals) {
  const std::string path = fresh_folder("t") + "/labelmap.txt";
  const auto load = [&](const std::string& text) {
    write_file_atomic(path, text);
    return load_cvat_labelmap(path);
  };
  const ClassTable table = load(
      "# label:color_rgb:parts:actions\nwall:128,0,64::\nbackground:0,0,0::\nchair, "
      "old:1,2,3:seat,back:sit\nlamp:::\n");
  ASSERT_EQ(table.entries().size(), 4u);
  EXPECT_EQ(table.valid(0).name, "wall");
  EXPECT_EQ(table.valid(0).color, (Color{128, 0, 64}));
  EXPECT_EQ(table.valid(1).name, "chair, old");
  EXPECT_EQ(table.valid(1).id, 2);
  EXPECT_EQ(table.valid(2).color, ClassTable::default_color(3));
  EXPECT_EQ(table.entries()[0].name, "background");
  EXPECT_TRUE(table.entries()[0].ignore);
  const ClassTable back = load(to_cvat_labelmap(table));
  EXPECT_EQ(back.to_yaml(), table.to_yaml());
  const auto error = [&](const std::string& text) { return error_of([&] { (void)load(text); }); };
  EXPECT_EQ(error("wall\n"),
            path + ":1: expected 'label:color_rgb:parts:actions'; export the label map from CVAT again");
  EXPECT_EQ(error("wall:1,2\n"), path + ":1: expected a colour 'r,g,b', got '1,2'; write lines 'label:r,g,b::'");
  EXPECT_EQ(error("wall:1,2,256\n"),
            path + ":1: expected a colour value from 0 to 255, got '256'; write lines 'label:r,g,b::'");
  EXPECT_EQ(error("wall:1,2,3\nwall:1,2,4\n"),
            path + ":2: label 'wall' stands in " + path + ":1 too; keep one of them");
  EXPECT_EQ(error("# nothing\n"), path + ": no labels in it; export the label map from CVAT again");
  EXPECT_EQ(error_of([] {
              (void)to_cvat_labelmap(ClassTable({{1, "a:b", {}, false}}));
            }),
            "class 'a:b': a label map cannot hold a name with ':'; rename the class");
}

TEST(ClassImport, ByExtension) {
  const std::string folder = fresh_folder("t");
  write_file_atomic(folder + "/l.tsv", std::string_view("id\traw_category\tnyu40id\teigen13id\n1\twall\t1\t12\n"
                                                        "2\toffice chair\t5\t4\n9\tstool\t5\t4\n50\tthing\t\t\n"));
  EXPECT_EQ(import_classes(folder + "/l.tsv").valid_count(), 4);
  EXPECT_EQ(load_scannet_classes(folder + "/l.tsv", ScannetIds::nyu40).valid_count(), 2);
  const ClassTable nyu13 = load_scannet_classes(folder + "/l.tsv", ScannetIds::nyu13);
  EXPECT_EQ(nyu13.valid(0).name, "chair");
  EXPECT_EQ(nyu13.valid(1).id, 12);
  const ClassTable table = published_classes("nyu13");
  write_file_atomic(folder + "/c.csv", to_class_csv(table));
  EXPECT_EQ(import_classes(folder + "/c.csv").valid_count(), 13);
  write_file_atomic(folder + "/c.txt", to_cvat_labelmap(table));
  EXPECT_EQ(import_classes(folder + "/c.txt").to_yaml(), table.to_yaml());
  EXPECT_NE(error_of([&] { (void)import_classes(folder + "/c.xml"); }).find("is not a class table"), std::string::npos);
}

// Commas, quotes and blanks of a name come back from the CSV that is written; what is quoted wrongly is named.
TEST(ClassImport, CsvQuotesNames) {
  const std::string file = fresh_folder("t") + "/c.csv";
  const std::vector<std::string> names{"chair, office", "the \"big\" table", " lamp ", "\"", "plain, \"both\""};
  std::vector<ClassEntry> entries;
  for (const std::string& name : names)
    entries.push_back({static_cast<std::int32_t>(entries.size()) + 1, name, {}, false});
  const std::string csv = to_class_csv(ClassTable(entries));
  EXPECT_NE(csv.find("1,\"chair, office\"\n2,\"the \"\"big\"\" table\"\n3,\" lamp \"\n"), std::string::npos) << csv;
  write_file_atomic(file, csv);
  const ClassTable back = import_classes(file);
  ASSERT_EQ(back.entries().size(), names.size());
  for (std::size_t i = 0; i < names.size(); ++i) EXPECT_EQ(back.entries()[i].name, names[i]);
  write_file_atomic(file, "1,\"chair\"s\n");
  EXPECT_EQ(
      error_of([&] { (void)import_classes(file); }),
      file + ":1: 's' follows a quoted field; write two double quotes for one inside, and nothing behind the last");
  write_file_atomic(file, "1,\"chair\n");
  EXPECT_NE(error_of([&] { (void)import_classes(file); }).find(":1: a quote is not closed"), std::string::npos);
}

TEST(ClassNames, VoidIsFoundAndAdded) {
  const ClassTable table = table_of_names({"chair", "Unlabelled", "wall"});
  EXPECT_EQ(table.index_of(0), kVoid);
  EXPECT_EQ(table.entries()[0].name, "Unlabelled");
  EXPECT_EQ(table.valid(1).name, "wall");
  EXPECT_EQ(table.valid(1).id, 2);
  EXPECT_EQ(ClassNames(table).index_of("Unlabelled", "here"), kVoid);
  EXPECT_EQ(ClassNames(table).index_of("other", "here"), kVoid);
  EXPECT_EQ(ClassNames(ClassTable({{3, "other", {}, false}})).index_of("other", "here"), 0);
  EXPECT_EQ(with_void({{0, "a", {}, false}, {1, "b", {}, false}}).index_of(2), kVoid);
  EXPECT_EQ(error_of([&] { (void)ClassNames(table).index_of("chiar", "here"); }),
            "here: no class 'chiar'; did you mean 'chair'?");
}

}  // namespace
}  // namespace semfield
