// Class tables: three file formats, numbering, refusals; tables and labels of other tools.
#include "scene/classes/class_table.h"

#include <set>

#include "scene/classes/class_import.h"
#include "system/files.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using testing_room::fresh_folder;

TEST(ClassTable, NumbersValidClassesInOrderOfId) {
  const ClassTable t(
      {{7, "chair", {1, 2, 3}, false}, {0, "void", {}, true}, {3, "wall", {}, false}, {9, "hand", {}, true}});
  EXPECT_EQ(t.valid_count(), 2);
  EXPECT_EQ(t.index_of(3), 0);
  EXPECT_EQ(t.index_of(7), 1);
  EXPECT_EQ(t.index_of(0), kVoid);
  EXPECT_EQ(t.index_of(9), kVoid);
  EXPECT_EQ(t.index_of(4), -2);
  EXPECT_EQ(t.index_of(1000), -2);
  EXPECT_EQ(t.index_of(-1), -2);
  EXPECT_EQ(t.id_of(1), 7);
  EXPECT_EQ(t.id_of(kVoid), 0);
  EXPECT_EQ(t.valid(1).name, "chair");
}

TEST(ClassTable, YamlRoundTripKeepsEverything) {
  const std::string path = fresh_folder("t") + "/classes.yaml";
  const ClassTable t(
      {{0, "void", {0, 0, 0}, true}, {3, "wall \"a\" \\ b", {10, 20, 255}, false}, {4, "yes", {1, 1, 1}, false}});
  write_file_atomic(path, t.to_yaml());
  const ClassTable back = ClassTable::load(path);
  ASSERT_EQ(back.entries().size(), 3u);
  for (std::size_t i = 0; i < 3; ++i) {
    EXPECT_EQ(back.entries()[i].id, t.entries()[i].id);
    EXPECT_EQ(back.entries()[i].name, t.entries()[i].name);
    EXPECT_EQ(back.entries()[i].color, t.entries()[i].color);
    EXPECT_EQ(back.entries()[i].ignore, t.entries()[i].ignore);
  }
}

TEST(ClassTable, CsvSkipsTheHeaderAndIgnoresVoid) {
  const std::string path = fresh_folder("t") + "/classes.csv";
  write_file_atomic(path, std::string_view("class_id,class\r\n0,Undefined\r\n2,\"base, cabinet\"\r\n\r\n1,wall\r\n"));
  const ClassTable t = ClassTable::load(path);
  EXPECT_EQ(t.valid_count(), 2);
  EXPECT_TRUE(t.entries()[0].ignore);
  EXPECT_EQ(t.valid(0).name, "wall");
  EXPECT_EQ(t.valid(1).name, "base, cabinet");
}

// What people export: names of columns, colours, other separators, void without a column that says so.
TEST(ClassTable, CsvColumnsAreReadByTheirNames) {
  const std::string path = fresh_folder("t") + "/classes.csv";
  const auto load = [&](const std::string& text) {
    write_file_atomic(path, text);
    std::string out;
    const ClassTable table = ClassTable::load(path);
    for (const ClassEntry& e : table.entries()) {
      out += std::to_string(e.id) + "=" + e.name + (e.ignore ? "!" : "");
      if (e.color != ClassTable::default_color(e.id))
        out += "(" + std::to_string(e.color[0]) + "," + std::to_string(e.color[1]) + "," + std::to_string(e.color[2]) +
               ")";
      out += " ";
    }
    return out;
  };
  const std::string wanted = "0=void!(9,9,9) 1=wall(174,199,232) 2=chair, old(152,223,138) ";
  EXPECT_EQ(load("id,name,red,green,blue\n0,void,9,9,9\n1,wall,174,199,232\n2,\"chair, old\",152,223,138\n"), wanted);
  EXPECT_EQ(load("\xEF\xBB\xBFName;R;G;B;Class ID;note\r\nvoid;9;9;9;0;\r\nwall;174;199;232;1;x\r\nchair, "
                 "old;152;223;138;2\r\n"),
            wanted);
  EXPECT_EQ(load("label\tname\tcolor\n0\tvoid\t#090909\n1\twall\t#AEC7e8\n2\tchair, old\t(152, 223, 138)\n"), wanted);
  EXPECT_EQ(load("0,void,9,9,9\n1,wall,174,199,232\n2,\"chair, old\",152,223,138\n"), wanted) << "in this order";
  EXPECT_EQ(load("id,name\n1,wall\n255,Ignore\n7,other\n"), "1=wall 7=other 255=Ignore! ");
  EXPECT_EQ(load("id,name,ignore\n0,void,false\n1,wall,TRUE\n"), "0=void 1=wall! ") << "the column counts";
  const auto refused = [&](const std::string& text) { return error_of([&] { (void)load(text); }); };
  EXPECT_HAS(refused("class_id,class\n2,base, cabinet\n"), path + ":2: 3 columns, the first line names 2");
  EXPECT_HAS(refused("id,name,red,green,blue\n2,base, cabinet,1,2,3\n"),
             path + ":2: 6 columns, the first line names 5");
  EXPECT_HAS(refused("2,base, cabinet\n"), path + ":1: colour: expected three numbers from 0 to 255, got 'cabinet,,'");
  EXPECT_HAS(refused("id,name,red,green,blue\n2,wall,1,2,256\n"), path + ":2: colour: ", "'1,2,256'");
  EXPECT_HAS(refused("id,name,color\n2,wall,#12345g\n"), path + ":2: colour: ");
  EXPECT_HAS(refused("name,red,green,blue\nwall,1,2,3\n"), path + ":1: no column 'id'");
  EXPECT_HAS(refused("id,red\n1,2\n"), path + ":1: no column 'name'");
  EXPECT_HAS(refused("id,name,id\n1,wall,1\n"), path + ":1: the column 'id' is named twice");
}

TEST(ClassTable, VoidWordsAreVoidWithoutIgnore) {
  const std::string folder = fresh_folder("t");
  write_file_atomic(folder + "/c.yaml",
                    std::string_view("- {id: 0, name: void}\n- {id: 1, name: __ignore__}\n- {id: 2, "
                                     "name: unknown}\n- {id: 3, name: void, ignore: false}\n"));
  const ClassTable yaml = ClassTable::load(folder + "/c.yaml");
  EXPECT_EQ(yaml.index_of(0), kVoid);
  EXPECT_EQ(yaml.index_of(1), kVoid);
  EXPECT_EQ(yaml.index_of(2), 0) << "data sets have such a class";
  EXPECT_EQ(yaml.index_of(3), 1) << "as it says";
  write_file_atomic(folder + "/c.json",
                    std::string_view(R"([{"id": 0, "name": "wall"}, {"id": 9, "name": "Unlabeled"}])"));
  const ClassTable json = ClassTable::load(folder + "/c.json");
  EXPECT_EQ(json.index_of(0), 0);
  EXPECT_EQ(json.index_of(9), kVoid);
}

TEST(ClassTable, ReplicaJsonGetsAVoidClass) {
  const std::string path = fresh_folder("t") + "/info_semantic.json";
  write_file_atomic(
      path,
      std::string_view(R"({"classes": [{"id": 2, "name": "b"}, {"id": 1, "name": "a"}, {"id": -1, "name": "x"}]})"));
  const ClassTable t = ClassTable::load(path);
  EXPECT_EQ(t.valid_count(), 2);
  EXPECT_EQ(t.index_of(0), kVoid);
  EXPECT_EQ(t.index_of(2), 1);
}

TEST(ClassTable, RefusalsNamePlaceAndRemedy) {
  const std::string folder = fresh_folder("t");
  const auto load = [&](const std::string& name, const std::string& text) {
    write_file_atomic(folder + "/" + name, text);
    return error_of([&] { (void)ClassTable::load(folder + "/" + name); });
  };
  EXPECT_EQ(load("a.csv", "id,name\n1,wall\nx2,floor\n"),
            folder + "/a.csv:3: expected a class id, got 'x2'; write one line 'id,name' for each class");
  EXPECT_EQ(load("b.csv", "1,wall\n1,floor\n"),
            folder + "/b.csv: class id 1 is given twice ('wall' and 'floor'); keep one of them");
  EXPECT_EQ(load("c.yaml", "- {id: 1, name: wall, colour: [1, 2, 3]}\n").find(folder + "/c.yaml:1:"), 0u);
  EXPECT_HAS(load("c.yaml", "- {id: 1, name: wall, colour: [1, 2, 3]}\n"),
             "unknown key 'colour' of a class; did you mean 'color'?");
  EXPECT_HAS(load("d.yaml", "- {id: 1, name: wall, color: [1, 2, 300]}\n"),
             "color: expected an integer from 0 to 255, got '300'");
  EXPECT_HAS(load("e.json", "{\"classes\": 3}"), "no list 'classes' in it");
  EXPECT_HAS(load("f.txt", "1,wall\n"), "is not a class table; give a .yaml, .csv or .json file");
  EXPECT_HAS(error_of([] { ClassTable({{-4, "x", {}, false}}); }), "has id -4");
  std::vector<ClassEntry> many;
  for (int i = 0; i < 1025; ++i) many.push_back({i, "c", {}, false});
  EXPECT_HAS(error_of([&] { (void)ClassTable(many); }), "1025 classes; at most 1024");
}

TEST(ClassTable, DefaultColorsDiffer) {
  std::set<std::array<std::uint8_t, 3>> seen;
  for (int id = 0; id < 200; ++id) seen.insert(ClassTable::default_color(id));
  EXPECT_EQ(seen.size(), 200u);
}

// Class tables of other tools.

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
  EXPECT_EQ(error("wall:1,2,3\nwall:1,2,4\n"), path + ":2: label 'wall' is in " + path + ":1 too; keep one of them");
  EXPECT_EQ(load("label:color_rgb:parts:actions\nwall:1,2,3::\n__ignore__:::\n").valid_count(), 1) << "a plain header";
  EXPECT_HAS(error("wall:1,2,3:::x\n"), path + ":1: expected 'label:color_rgb:parts:actions'");
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
  EXPECT_EQ(to_class_csv(ClassTable({{0, "void", {}, true}, {3, "hand", {}, true}})),
            "class_id,class,ignore\n0,void,true\n3,hand,true\n");
  write_file_atomic(folder + "/c.txt", to_cvat_labelmap(table));
  EXPECT_EQ(import_classes(folder + "/c.txt").to_yaml(), table.to_yaml());
  EXPECT_HAS(error_of([&] { (void)import_classes(folder + "/c.xml"); }), "is not a class table");
}

// Commas, quotes and blanks of a name come back from the CSV that is written; what is quoted wrongly is named.
TEST(ClassImport, CsvQuotesNames) {
  const std::string file = fresh_folder("t") + "/c.csv";
  const std::vector<std::string> names{
      "chair, office", "the \"big\" table", " lamp ", "\"", "plain, \"both\"", "=1+1", "+cup", "-", "@here, there",
      "'=1",           "'quoted'",          "a=b"};
  std::vector<ClassEntry> entries;
  for (const std::string& name : names)
    entries.push_back({static_cast<std::int32_t>(entries.size()) + 1, name, {}, false});
  const std::string csv = to_class_csv(ClassTable(entries));
  EXPECT_HAS(csv, "1,\"chair, office\"\n2,\"the \"\"big\"\" table\"\n3,\" lamp \"\n");
  // A spreadsheet takes what begins with one of = + - @ for a formula, in quotes too.
  EXPECT_HAS(csv, "6,'=1+1\n7,'+cup\n8,'-\n9,\"'@here, there\"\n10,''=1\n11,'quoted'\n12,a=b\n");
  write_file_atomic(file, csv);
  const ClassTable back = import_classes(file);
  ASSERT_EQ(back.entries().size(), names.size());
  for (std::size_t i = 0; i < names.size(); ++i) EXPECT_EQ(back.entries()[i].name, names[i]);
  write_file_atomic(file, "1,\"chair\"s\n");
  EXPECT_EQ(
      error_of([&] { (void)import_classes(file); }),
      file + ":1: 's' follows a quoted field; write two double quotes for one inside, and nothing behind the last");
  write_file_atomic(file, "1,\"chair\n");
  EXPECT_HAS(error_of([&] { (void)import_classes(file); }), ":1: a quote is not closed");
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

TEST(ClassNames, VoidWordsOfTools) {
  for (const char* name : {"void", "VOID", "__ignore__", "_background_", "__background__", "<unlabeled>", "(none)",
                           "No-label", "don't care", "Unassigned", "other"})
    EXPECT_TRUE(is_void_name(name)) << name;
  for (const char* name : {"background", "avoid", "others", "other furniture", "", "__", "ignored items"})
    EXPECT_FALSE(is_void_name(name)) << name;
  EXPECT_TRUE(is_void_entry(0, "other"));
  EXPECT_FALSE(is_void_entry(5, "other"));
  EXPECT_TRUE(is_void_entry(5, "ignore"));
}

TEST(ClassNames, ANameOfTwoClassesIsRefusedWhereItIsUsed) {
  const ClassNames names(ClassTable({{1, "chair", {}, false}, {2, "wall", {}, false}, {5, "chair", {}, false}}));
  EXPECT_EQ(names.index_of("wall", "here"), 1);
  EXPECT_HAS(error_of([&] { (void)names.index_of("chair", "here"); }), "here: the class table has 'chair' twice");
}

// ScanNet's label table: columns by name, maps, refusals.

const std::string kHeader = "id\traw_category\tcount\tnyu40id\teigen13id\tnyu40class\teigen13class\n";

TEST(ScannetLabels, ColumnsAreFoundByName) {
  const std::string path = fresh_folder("t") + "/labels.tsv";
  write_file_atomic(path, kHeader + "1\twall\t8277\t1\t12\twall\tWall\r\n2\toffice \"chair\"\t4\t5\t4\tchair\tChair\n" +
                              "1163\tobject\t9\t\t\t\t\n");
  const std::vector<ScannetLabel> labels = read_scannet_tsv(path);
  ASSERT_EQ(labels.size(), 3u);
  EXPECT_EQ(labels[0].eigen13class, "Wall");
  EXPECT_EQ(labels[1].raw_category, "office \"chair\"");
  EXPECT_EQ(labels[1].nyu40class, "chair");
  EXPECT_EQ(nyu40_of_scannet(labels).at(2), 5);
  EXPECT_EQ(eigen13_of_scannet(labels).at(1), 12);
  EXPECT_EQ(nyu40_of_scannet(labels).at(1163), 0);
  write_file_atomic(path, std::string_view("nyu40id\traw_category\tid\n3\tcabinet\t7\n"));
  EXPECT_EQ(nyu40_of_scannet(read_scannet_tsv(path)).at(7), 3);
}

TEST(ScannetLabels, RefusalsNameLineAndColumn) {
  const std::string path = fresh_folder("t") + "/labels.tsv";
  const auto read = [&](const std::string& text) {
    write_file_atomic(path, text);
    return error_of([&] { (void)read_scannet_tsv(path); });
  };
  const std::string give = "; give scannetv2-labels.combined.tsv: tab-separated, with a line of column names";
  const std::string restore = "; restore the table as ScanNet distributes it";
  EXPECT_EQ(read(""), path + ": no rows in it" + give);
  EXPECT_EQ(read("raw_category\tnyu40id\n"), path + ":1: no column 'id'" + give);
  EXPECT_EQ(read("id\traw_category\n"), path + ":1: neither a column 'nyu40id' nor a column 'eigen13id'" + give);
  EXPECT_EQ(read(kHeader + "1\twall\n"), path + ":2: 2 columns, the first line names 7" + give);
  EXPECT_EQ(read(kHeader + "1\twall\t1\t41\t1\ta\tb\n"),
            path + ":2: nyu40id: expected a number from 0 to 40, got '41'" + restore);
  EXPECT_EQ(read(kHeader + "1\twall\t1\t4\tx\ta\tb\n"),
            path + ":2: eigen13id: expected a number from 0 to 13, got 'x'" + restore);
  EXPECT_EQ(read(kHeader + "\twall\t1\t4\t1\ta\tb\n"), path + ":2: the row has no id" + give);
  EXPECT_EQ(read(kHeader + "1\twall\t1\t1\t12\ta\tb\n1\tdoor\t1\t8\t12\ta\tb\n"),
            path + ":3: id 1 ('door') is given before ('wall') with another class" + give);
  EXPECT_HAS(error_of([&] { (void)read_scannet_tsv(path + "x"); }), "cannot open");
}

}  // namespace
}  // namespace semfield
