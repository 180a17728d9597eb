// NumPy arrays: types, orders, archives, and files that lie.
#include "formats/npz.h"

#include <zlib.h>

#include <cstring>

#include "core/rng.h"
#include "core/workspace.h"
#include "formats/text_rows.h"
#include "system/files.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

std::string npy(const std::string& header, const std::string& data, int version = 1) {
  std::string out = "\x93NUMPY";
  out += static_cast<char>(version);
  out += '\0';
  out += static_cast<char>(header.size() & 0xFF);
  out += static_cast<char>(header.size() >> 8);
  if (version > 1) out += std::string(2, '\0');
  return out + header + data;
}
std::string header(const std::string& type, const std::string& shape, const std::string& fortran = "False") {
  return "{'descr': '" + type + "', 'fortran_order': " + fortran + ", 'shape': " + shape + ", }\n";
}
template <class T>
std::string bytes_of(const std::vector<T>& values) {
  return {reinterpret_cast<const char*>(values.data()), values.size() * sizeof(T)};
}

struct NpyCase {
  std::string path = fresh_folder("t") + "/a.npy";
  NumpyArray read(const std::string& bytes) const {
    plain_write(path, bytes);
    return read_npy(path, {});
  }
  std::string error(const std::string& bytes) const {
    return error_of([&] { (void)read(bytes); });
  }
};

TEST(Npy, TypesOrdersAndVersions) {
  const NpyCase c;
  const std::vector<float> want{0, 0.5F, 1, 1.5F, 2, 2.5F};
  EXPECT_EQ(c.read(npy(header("<f4", "(2, 3)"), bytes_of(want))).values, want);
  EXPECT_EQ(c.read(npy(header("<f4", "(2, 3)"), bytes_of(want), 2)).shape, (std::vector<std::int64_t>{2, 3}));
  EXPECT_EQ(c.read(npy(header("<f8", "(6,)"), bytes_of(std::vector<double>(want.begin(), want.end())))).values, want);
  EXPECT_EQ(c.read(npy(header("<f2", "(2,)"), bytes_of(std::vector<std::uint16_t>{0x3C00, 0x3800}))).values,
            (std::vector<float>{1, 0.5F}));
  EXPECT_EQ(c.read(npy(header(">f2", "(2,)"), std::string("\x3C\x00\x38\x00", 4))).values,
            (std::vector<float>{1, 0.5F}));
  const NumpyArray u = c.read(npy(header("|u1", "(3,)"), std::string("\xFF\x00\x33", 3)));
  EXPECT_TRUE(u.from_bytes);
  EXPECT_EQ(u.values, (std::vector<float>{1, 0, 0.2F}));
  EXPECT_EQ(c.read(npy(header("<f4", "(3, 2)", "True"), bytes_of(want))).values,
            (std::vector<float>{0, 1.5F, 0.5F, 2, 1, 2.5F}));
  EXPECT_EQ(c.read(npy(header("<f4", "()"), bytes_of(std::vector<float>{7}))).values, (std::vector<float>{7}));
  EXPECT_TRUE(c.read(npy(header("<f4", "(0, 3)"), "")).values.empty());
}

TEST(Npy, HeadersThatLieAreRefusedBeforeAnythingIsAllocated) {
  const NpyCase c;
  const std::string file = "'" + c.path + "': ", again = "; save the file again, or copy it again in full";
  EXPECT_EQ(c.error("hello"), file + "not a NumPy array: it begins with other bytes");
  EXPECT_EQ(c.error(npy("", "", 9)), file + "NumPy format version 9 is not read");
  EXPECT_EQ(c.error(std::string("\x93NUMPY\x01\x00\xFF\xFFx", 11)),
            file + "the header runs past the end of the file" + again);
  EXPECT_EQ(c.error(std::string("\x93NUMPY\x02\x00\xFF\xFF", 10)),
            file + "the header runs past the end of the file" + again);
  EXPECT_EQ(c.error(npy("{'shape': (3,)}", "")), file + "the header has no 'descr'" + again);
  EXPECT_EQ(c.error(npy("{'descr': '<f4', 'shape': (3,), }", "")), file + "the header has no 'fortran_order'" + again);
  EXPECT_EQ(c.error(npy("{'descr': '<f4', 'fortran_order': False, }", "")), file + "the header has no 'shape'" + again);
  EXPECT_EQ(c.error(npy(header("<f4", "(3,)", "Maybe"), "")),
            file + "the header's 'fortran_order' is neither True nor False" + again);
  EXPECT_EQ(c.error(npy(header("<f4", "3)"), "")), file + "the header's 'shape' is not a tuple" + again);
  EXPECT_EQ(c.error(npy(header("<f4", "(3, -2)"), "")), file + "the header's shape has the axis '-2'");
  EXPECT_EQ(c.error(npy(header("<f4", "(3, x)"), "")), file + "the header's shape has the axis 'x'");
  EXPECT_EQ(c.error(npy(header("<i8", "(1,)"), "12345678")),
            file + "arrays of type '<i8' are not read; save it as float16, float32, float64 or uint8");
  EXPECT_EQ(c.error(npy(header("O", "(1,)"), "12345678")).find(file), 0u);
  EXPECT_EQ(c.error(npy(header("<f4", "(3,)"), "12345678")),
            file + "the header states the shape (3,) of type <f4, 8 bytes follow it" + again);
  EXPECT_EQ(c.error(npy(header("<f4", "(2,)"), "123456789")),
            file + "the header states the shape (2,) of type <f4, 9 bytes follow it" + again);
  // 2^62 * 4 values: the product overflows 64 bits.
  EXPECT_EQ(c.error(npy(header("<f4", "(4611686018427387904, 4, 2)"), "12345678")),
            file + "the header states the shape (4611686018427387904, 4, 2) of type <f4, 8 bytes follow it" + again);
  EXPECT_EQ(c.error(npy(header("<f4", "(99999999999999999999,)"), "1234")),
            file + "the header's shape has the axis '99999999999999999999'");
  EXPECT_EQ(c.error(npy(header("<f4", "(1,1,1,1,1,1,1,1,1)"), "1234")), file + "9 axes; at most 8 are read");
}

TEST(Npz, WrittenArraysAreReadBack) {
  const std::string path = fresh_folder("t") + "/a.npz";
  std::vector<float> values;
  for (int i = 0; i < 1000; ++i) values.push_back(static_cast<float>(i) / 1024.0F);
  const std::vector<NpzEntry> entries{{"probability", {10, 20, 5}, values}, {"one", {1}, std::span(values).first(1)}};
  write_npz(path, entries);
  EXPECT_EQ(npz_keys(path), (std::vector<std::string>{"probability", "one"}));
  const NumpyArray back = read_npz(path, "probability", {});
  EXPECT_EQ(back.shape, (std::vector<std::int64_t>{10, 20, 5}));
  EXPECT_EQ(back.values, values);
  EXPECT_EQ(error_of([&] { (void)read_npz(path, "two", {}); }),
            "'" + path + "': no array 'two' in it; it has: probability, one");
}

TEST(Npz, BytesAndIntegersAreReadAsTheyAreStored) {
  const std::string path = fresh_folder("t") + "/a.npz";
  ZipWriter archive(path);
  archive.add("mask.npy", npy(header("|b1", "(2, 2)", "True"), std::string("\1\0\0\2", 4)));
  archive.add("short.npy", npy(header(">i2", "(2,)"), std::string("\xFF\xFE\x01\x02", 4)));
  archive.add("long.npy", npy(header("<i8", "(1,)"), bytes_of(std::vector<std::int64_t>{-5})));
  archive.add("wide.npy", npy(header("<u8", "(1,)"), std::string(8, '\1')));
  archive.write();
  const NpzFile file(path);
  EXPECT_EQ(file.keys(), (std::vector<std::string>{"mask", "short", "long", "wide"}));
  EXPECT_EQ(file.bytes("mask", {}).values, (std::vector<std::uint8_t>{1, 0, 0, 2}));
  EXPECT_EQ(file.whole("short", {}).values, (std::vector<std::int64_t>{-2, 258}));
  EXPECT_EQ(file.whole("long", {}).values, (std::vector<std::int64_t>{-5}));
  EXPECT_EQ(error_of([&] { (void)file.whole("wide", {}); }),
            "'" + path + "', entry 'wide': arrays of type '<u8' are not read; save it as int64");
  EXPECT_EQ(error_of([&] { (void)file.bytes("short", {}); }),
            "'" + path + "', entry 'short': arrays of type '>i2' are not read; save it as bool or uint8");
}

void put(std::string& out, std::uint64_t value, int bytes) {
  for (int i = 0; i < bytes; ++i) out += static_cast<char>((value >> (8 * i)) & 0xFF);
}

// An archive of one stored entry, with ZIP64 sizes in both headers.
std::string stored64(const std::string& data, std::uint64_t bytes, std::uint64_t packed, unsigned method = 0,
                     unsigned flags = 0) {
  const auto crc =
      static_cast<std::uint32_t>(crc32(0, reinterpret_cast<const Bytef*>(data.data()), static_cast<uInt>(data.size())));
  std::string common, out;
  put(common, 45, 2);
  put(common, flags, 2);
  put(common, method, 2);
  put(common, 0, 4);
  put(common, crc, 4);
  put(common, 0xFFFFFFFF, 4);
  put(common, 0xFFFFFFFF, 4);
  put(common, 5, 2);
  put(common, 20, 2);
  std::string extra;
  put(extra, 1, 2);
  put(extra, 16, 2);
  put(extra, bytes, 8);
  put(extra, packed, 8);
  put(out, 0x04034b50, 4);
  out += common + "a.npy" + extra + data;
  const std::size_t directory = out.size();
  put(out, 0x02014b50, 4);
  put(out, 45, 2);
  out += common;
  put(out, 0, 8);
  put(out, 0, 2);
  put(out, 0, 4);
  out += "a.npy" + extra;
  const std::size_t size = out.size() - directory;
  put(out, 0x06054b50, 4);
  put(out, 0, 4);
  put(out, 1, 2);
  put(out, 1, 2);
  put(out, size, 4);
  put(out, directory, 4);
  put(out, 0, 2);
  return out;
}

TEST(Npz, Zip64SizesAndArchivesThatLie) {
  const std::string path = fresh_folder("t") + "/a.npz";
  const std::string data = npy(header("<f4", "(2,)"), bytes_of(std::vector<float>{3, 4}));
  plain_write(path, stored64(data, data.size(), data.size()));
  EXPECT_EQ(read_npz(path, "a", {}).values, (std::vector<float>{3, 4}));
  const auto error = [&](const std::string& bytes) {
    plain_write(path, bytes);
    return error_of([&] { (void)read_npz(path, "a", {}); });
  };
  const std::string file = "'" + path + "', entry 'a': ", again = "; save the file again, or copy it again in full";
  EXPECT_EQ(error(stored64(data, 99, data.size())), file + "its two sizes differ though it is not packed" + again);
  EXPECT_EQ(error(stored64(data, 1ull << 60, 1ull << 60)), file + "it runs past the end of the file" + again);
  EXPECT_EQ(error(stored64(data, 1ull << 60, data.size(), 8)),
            file + "it claims to hold 1152921504606846976 bytes, more than its " + std::to_string(data.size()) +
                " packed ones can be" + again);
  EXPECT_EQ(error(stored64(data, 500, data.size(), 8)), file + "its packed data are damaged or cut off" + again);
  EXPECT_EQ(error(stored64(data, data.size(), data.size(), 12)),
            file + "compression method 12 is not read; save it with numpy.savez or numpy.savez_compressed");
  EXPECT_EQ(error(stored64(data, data.size(), data.size(), 0, 1)), "'" + path + "': entry 'a.npy' is encrypted");
  std::string bad = stored64(data, data.size(), data.size());
  bad[30 + 5 + 20 + data.size() - 1] ^= 1;
  EXPECT_EQ(error(bad), file + "its checksum is wrong" + again);
  EXPECT_EQ(error(""), "'" + path + "': not a zip archive: its end is missing" + again);
}

// Whatever bytes are damaged, reading ends with an Error or with values, never otherwise.
TEST(Npz, DamageNeverCrashes) {
  const std::string path = fresh_folder("t") + "/a.npz";
  std::vector<float> values(64);
  for (std::size_t i = 0; i < values.size(); ++i) values[i] = static_cast<float>(i);
  const std::vector<NpzEntry> entries{{"a", {4, 4, 4}, values}};
  write_npz(path, entries);
  const std::string good = read_text_file(path);
  int refused = 0;
  for (std::uint64_t trial = 0; trial < 600; ++trial) {
    std::string bytes = good;
    const RandomAddress address{trial, 0, stream_id("npz")};
    for (std::uint64_t k = 0; k < 1 + trial % 4; ++k)
      bytes[uniform_below(address, 2 * k, bytes.size())] = static_cast<char>(uniform_below(address, 2 * k + 1, 256));
    if (trial % 5 == 0) bytes.resize(uniform_below(address, 99, bytes.size()));
    plain_write(path, bytes);
    refused += error_of([&] { (void)read_npz(path, "a", {}); }).empty() ? 0 : 1;
  }
  EXPECT_GT(refused, 300);
}

// The last bytes are damaged: whoever unpacks them before the shape is compared reports the damage instead.
TEST(Npz, AShapeThatIsNotWantedIsRefusedBeforeAnythingIsUnpacked) {
  const std::string path = fresh_folder("t") + "/a.npz";
  std::vector<float> values(400'000);
  for (std::size_t i = 0; i < values.size(); ++i)  // what does not pack
    values[i] = static_cast<float>(uniform_below({1, 0, stream_id("npz")}, i, 2048));
  const NpzEntry entry{"a", {400, 1000}, values};
  write_npz(path, std::span(&entry, 1));
  std::string file = read_text_file(path);
  for (std::size_t at = file.size() - 4200; at < file.size() - 4100; ++at) file[at] = static_cast<char>(~file[at]);
  plain_write(path, file);
  const auto read = [&](std::int64_t width) {
    return error_of([&] {
      (void)read_npz(path, "a", [&](std::span<const std::int64_t> shape) {
        if (shape[1] != width) throw Error(ErrorKind::data, "test.error.made", "another shape: " + shape_text(shape));
      });
    });
  };
  EXPECT_EQ(read(999), "'" + path + "', entry 'a': another shape: (400, 1000)");
  EXPECT_HAS(read(1000), path);
  EXPECT_LACKS(read(1000), "another shape");
}

TEST(Npy, IntegersAndRealNumbersAsTheyAreStored) {
  const NpyCase c;
  const auto read = [&](const std::string& bytes) {
    plain_write(c.path, bytes);
    return read_npy_values(c.path, {});
  };
  const NumpyValues steps = read(npy(header("<u2", "(2, 2)"), bytes_of<std::uint16_t>({1, 65535, 3, 4})));
  EXPECT_EQ(steps.values, (std::vector<double>{1, 65535, 3, 4}));
  EXPECT_TRUE(steps.is_whole);
  EXPECT_EQ(steps.element_bytes, 2u);
  EXPECT_TRUE(npy_is_whole(c.path));
  EXPECT_EQ(npy_shape(c.path), (std::vector<std::int64_t>{2, 2}));
  EXPECT_EQ(read(npy(header("|u1", "(2,)"), "\x01\xFF")).values, (std::vector<double>{1, 255}));
  EXPECT_EQ(read(npy(header(">i2", "(2,)"), std::string("\x00\x02\xFF\xFE", 4))).values, (std::vector<double>{2, -2}));
  const NumpyValues real = read(npy(header("<f8", "(1,)"), bytes_of<double>({0.1})));
  EXPECT_EQ(real.values, (std::vector<double>{0.1}));
  EXPECT_FALSE(real.is_whole);
  EXPECT_FALSE(npy_is_whole(c.path));
  EXPECT_ERROR(read(npy(header("<u8", "(1,)"), std::string(8, '\1'))), "files.array.type", "<u8");
}

// Fortran order: the first axis is the fastest. Long axes go in blocks.
TEST(Npy, FortranOrderOfAnyShape) {
  const NpyCase c;
  for (const std::vector<std::int64_t>& shape : std::vector<std::vector<std::int64_t>>{
           {5}, {70, 130}, {2, 3, 4}, {70, 2, 130}, {3, 2, 1, 2, 65}, {1, 66, 2}, {0, 3}}) {
    std::vector<std::int32_t> stored;
    std::int64_t count = 1;
    for (const std::int64_t axis : shape) count *= axis;
    for (std::int32_t i = 0; i < count; ++i) stored.push_back(i);
    plain_write(c.path, npy(header("<i4", shape_text(shape), "True"), bytes_of(stored)));
    const NumpyValues found = read_npy_values(c.path, {});
    for (std::int64_t place = 0; place < count; ++place) {
      std::int64_t rest = place, from = 0;  // from the index in C order to the place in Fortran order
      for (std::size_t a = shape.size(); a-- > 0; rest /= shape[a]) from = from * shape[a] + rest % shape[a];
      ASSERT_EQ(found.values.at(static_cast<std::size_t>(place)), from) << shape_text(shape) << " at " << place;
    }
  }
}

// Each entry would unpack the same bytes again.
TEST(Npz, EntriesThatOverlapAreRefused) {
  const std::string path = fresh_folder("o") + "/a.npz";
  const std::vector<float> values(100, 1);
  const NpzEntry entries[] = {{"a", {100}, values}, {"b", {100}, values}};
  write_npz(path, entries);
  EXPECT_EQ(NpzFile(path).keys().size(), 2u);
  std::string file = read_text_file(path);
  const std::size_t second = file.rfind("PK\x01\x02");
  for (std::size_t i = 0; i < 4; ++i) file[second + 42 + i] = '\0';  // where its data begin
  plain_write(path, file);
  EXPECT_ERROR(NpzFile(path), "files.zip.damaged", "'a.npy' and 'b.npy' overlap");
}

TEST(Npy, AShapeThatIsNotWantedOrTooLargeIsRefusedByItsHeader) {
  const NpyCase c;
  plain_write(c.path, npy(header("|u1", "(2, 3)"), std::string(6, '\1')));
  EXPECT_EQ(error_of([&] {
              (void)read_npy(c.path, [](std::span<const std::int64_t> shape) {
                throw Error(ErrorKind::data, "test.error.made", "not " + shape_text(shape));
              });
            }),
            "'" + c.path + "': not (2, 3)");
  InputLimits small;
  small.image_bytes = 23;  // six values of four bytes are 24
  WorkSettings work{.limits = &small};
  const std::string refused = error_of([&] {
    const WorkScope scope(work);
    (void)read_npy(c.path, {});
  });
  EXPECT_HAS(refused, "'" + c.path + "'", "(2, 3)", "24 bytes", "at most 23", "limits.image_bytes");
}

}  // namespace
}  // namespace semfield
