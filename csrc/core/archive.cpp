#include "archive.h"

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <bit>
#include <cerrno>
#include <charconv>
#include <cstring>
#include <new>
#include <system_error>

namespace darswin {
namespace {

static_assert(std::endian::native == std::endian::little, "arrays are read as they are stored");

void require(bool condition, const char* what) {
  if (!condition) throw std::invalid_argument(what);
}

// The tables of the CRC-32 of zip files: table k is of a byte that k more bytes follow.
constexpr int kSlices = 16;
constexpr auto kCrc = [] {
  std::array<std::array<uint32_t, 256>, kSlices> tables{};
  for (uint32_t byte = 0; byte < 256; ++byte) {
    uint32_t value = byte;
    for (int bit = 0; bit < 8; ++bit) value = (value >> 1) ^ (value & 1 ? 0xEDB88320u : 0);
    tables[0][byte] = value;
  }
  for (int k = 1; k < kSlices; ++k) {
    for (int byte = 0; byte < 256; ++byte) {
      const uint32_t before = tables[k - 1][byte];
      tables[k][byte] = (before >> 8) ^ tables[0][before & 255];
    }
  }
  return tables;
}();

uint32_t crc_of(const void* data, size_t bytes, uint32_t before = 0) {
  const auto* at = static_cast<const uint8_t*>(data);
  uint32_t crc = ~before;
  for (; bytes >= kSlices; bytes -= kSlices, at += kSlices) {
    uint32_t words[kSlices / 4], sum = 0;
    std::memcpy(words, at, kSlices);
    words[0] ^= crc;
    for (int k = 0; k < kSlices; ++k) {
      sum ^= kCrc[kSlices - 1 - k][words[k / 4] >> (k % 4 * 8) & 255];
    }
    crc = sum;
  }
  for (; bytes > 0; --bytes) crc = (crc >> 8) ^ kCrc[0][(crc ^ *at++) & 255];
  return ~crc;
}

class File {
 public:
  explicit File(const std::string& path) {
    // Without O_NONBLOCK, a pipe would wait for its other end.
    descriptor = open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK);
    if (descriptor < 0) throw std::system_error(errno, std::generic_category());
    size = lseek(descriptor, 0, SEEK_END);
    if (size < 0) {
      close(descriptor);
      throw std::invalid_argument("it is a pipe, a socket or a device");
    }
  }
  ~File() { close(descriptor); }
  File(const File&) = delete;

  void read(int64_t offset, void* to, int64_t bytes) const {
    require(offset >= 0 && bytes >= 0 && offset <= size && bytes <= size - offset,
            "an entry lies beyond its end");
    for (auto* at = static_cast<char*>(to); bytes > 0;) {
      const ssize_t got = pread(descriptor, at, std::min(bytes, int64_t{1} << 30), offset);
      if (got < 0 && errno == EINTR) continue;
      if (got < 0) throw std::system_error(errno, std::generic_category());
      require(got > 0, "it became shorter");
      at += got, offset += got, bytes -= got;
    }
  }
  std::string read(int64_t offset, int64_t bytes) const {
    require(bytes >= 0 && bytes <= size, "an entry lies beyond its end");
    std::string text(bytes, '\0');
    read(offset, text.data(), bytes);
    return text;
  }

  int64_t size = 0;

 private:
  int descriptor;
};

// A number of a header.
template <typename T>
T field(std::string_view header, size_t at) {
  T value;
  require(at <= header.size() && sizeof value <= header.size() - at, "a header ends too early");
  std::memcpy(&value, header.data() + at, sizeof value);
  return value;
}

// A file of the archive: what its central directory says of it.
struct Entry {
  std::string name;
  int64_t begin, bytes;  // of the local header; of the content
  uint32_t crc;
  int64_t content = 0;  // where it begins
};

constexpr size_t kEnd = 22, kEnd64 = 56, kLocator = 20, kCentral = 46, kLocal = 30;

// The place, the bytes and the count of the entries of the central directory.
struct Directory {
  int64_t begin, bytes, count;
};

Directory find_directory(const File& file) {
  constexpr int64_t kMostComment = UINT16_MAX;
  const int64_t length = std::min<int64_t>(file.size, kMostComment + kEnd + kLocator);
  const std::string tail = file.read(file.size - length, length);
  for (size_t at = tail.size() < kEnd ? 0 : tail.size() - kEnd + 1; at-- > 0;) {
    const std::string_view end = std::string_view(tail).substr(at);
    if (!end.starts_with("PK\5\6") || end.size() != kEnd + field<uint16_t>(end, 20)) continue;
    if (at >= kLocator && tail.compare(at - kLocator, 4, "PK\6\7") == 0) {
      const std::string large =
          file.read(field<int64_t>(tail, at - kLocator + 8), static_cast<int64_t>(kEnd64));
      require(large.starts_with("PK\6\6"), "its end is damaged");
      return {field<int64_t>(large, 48), field<int64_t>(large, 40), field<int64_t>(large, 32)};
    }
    return {field<uint32_t>(end, 16), field<uint32_t>(end, 12), field<uint16_t>(end, 10)};
  }
  throw std::invalid_argument("it is no zip archive, or its end is missing");
}

// Replaces sizes and places of 32 bits that do not fit by those of the "extra" field of zip64.
void read_zip64(std::string_view extra, std::initializer_list<int64_t*> values) {
  size_t at = 4;
  while (!extra.empty() && field<uint16_t>(extra, 0) != 1) {
    const size_t length = 4 + size_t{field<uint16_t>(extra, 2)};
    require(length <= extra.size(), "a header is damaged");
    extra.remove_prefix(length);
  }
  for (int64_t* value : values) {
    if (*value != UINT32_MAX) continue;
    *value = field<int64_t>(extra, at);
    at += sizeof *value;
  }
}

std::vector<Entry> entries_of(const File& file) {
  const Directory directory = find_directory(file);
  const std::string central = file.read(directory.begin, directory.bytes);
  std::vector<Entry> entries;
  size_t at = 0;
  for (; at < central.size();) {
    const std::string_view header = std::string_view(central).substr(at);
    require(header.starts_with("PK\1\2"), "its directory is damaged");
    const size_t name = field<uint16_t>(header, 28), extra = field<uint16_t>(header, 30),
                 comment = field<uint16_t>(header, 32);
    require(kCentral + name + extra + comment <= header.size(), "its directory is damaged");
    require((field<uint16_t>(header, 8) & 1) == 0 && field<uint16_t>(header, 10) == 0,
            "its arrays must be stored as np.savez does, without compression");
    int64_t packed = field<uint32_t>(header, 20), bytes = field<uint32_t>(header, 24),
            begin = field<uint32_t>(header, 42);
    read_zip64(header.substr(kCentral + name, extra), {&bytes, &packed, &begin});
    require(packed == bytes && bytes >= 0, "its directory is damaged");
    entries.push_back(
        {std::string(header.substr(kCentral, name)), begin, bytes, field<uint32_t>(header, 16)});
    at += kCentral + name + extra + comment;
  }
  require(static_cast<int64_t>(entries.size()) == directory.count, "its directory is damaged");
  std::sort(entries.begin(), entries.end(),
            [](const Entry& one, const Entry& other) { return one.begin < other.begin; });
  int64_t last = 0;
  for (Entry& entry : entries) {
    require(entry.begin >= last, "its arrays overlap");
    const std::string header = file.read(entry.begin, kLocal);
    require(header.starts_with("PK\3\4"), "a header is damaged");
    const int64_t name = field<uint16_t>(header, 26);
    require(file.read(entry.begin + static_cast<int64_t>(kLocal), name) == entry.name,
            "a name is damaged");
    entry.content = entry.begin + static_cast<int64_t>(kLocal) + name + field<uint16_t>(header, 28);
    require(entry.content <= directory.begin && entry.bytes <= directory.begin - entry.content,
            "an array lies beyond its end");
    last = entry.content + entry.bytes;
  }
  return entries;
}

// Reads the text of a header of .npy from front to back.
struct Header {
  std::string_view text;

  bool skip(std::string_view expected) {
    if (!text.starts_with(expected)) return false;
    text.remove_prefix(expected.size());
    return true;
  }
  int64_t number() {
    int64_t value = -1;
    const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
    require(error == std::errc() && value >= 0, "a shape is damaged");
    text.remove_prefix(end - text.data());
    return value;
  }
};

ArchiveArray read_array(const File& file, const Entry& entry) {
  constexpr const char* kWrong = "an array is not in C order, or not as np.savez writes it";
  const std::string start = file.read(entry.content, std::min<int64_t>(entry.bytes, 12));
  require(start.starts_with("\x93NUMPY"), kWrong);
  const bool is_long = field<uint8_t>(start, 6) > 1;  // the version of the format
  const int64_t length =
      is_long ? 12 + int64_t{field<uint32_t>(start, 8)} : 10 + int64_t{field<uint16_t>(start, 8)};
  require(length <= entry.bytes, kWrong);
  const std::string whole = file.read(entry.content, length);
  Header header{std::string_view(whole).substr(is_long ? 12 : 10)};
  require(header.skip("{'descr': '"), kWrong);
  ArchiveArray array{
      .type = std::string(header.text.substr(0, header.text.find('\''))), .shape = {}, .count = 1};
  header.text.remove_prefix(array.type.size());
  require(header.skip("', 'fortran_order': False, 'shape': ("), kWrong);
  while (!header.skip(")")) {
    array.shape.push_back(header.number());
    require(!__builtin_mul_overflow(array.count, array.shape.back(), &array.count), kWrong);
    header.skip(",");
    header.skip(" ");
  }
  require(header.skip(", }") && header.text.find_first_not_of(" \n") == header.text.npos, kWrong);
  // Of a text, 4 bytes for each of its characters; of numbers, their size.
  const bool is_text = array.type.starts_with("<U");
  require(array.type.size() > 2, kWrong);
  const int64_t item = Header{std::string_view(array.type).substr(2)}.number();
  require(item > 0, kWrong);
  int64_t bytes;
  require(!__builtin_mul_overflow(array.count, item, &bytes) &&
              !__builtin_mul_overflow(bytes, is_text ? 4 : 1, &bytes) &&
              bytes == entry.bytes - length,
          "an array has another size than its shape");
  constexpr int64_t kLine = 64;
  array.data.reset(static_cast<char*>(std::aligned_alloc(kLine, (bytes / kLine + 1) * kLine)));
  if (array.data == nullptr) throw std::bad_alloc();
  file.read(entry.content + length, array.data.get(), bytes);
  const uint32_t crc = crc_of(array.data.get(), bytes, crc_of(whole.data(), whole.size()));
  require(crc == entry.crc, "an array has other values than those that were written");
  return array;
}

// Adds a character to a text in UTF-8.
void append(std::string& text, uint32_t character) {
  const auto part = [&](int shift) {
    return static_cast<char>(0x80 | ((character >> shift) & 0x3F));
  };
  if (character < 0x80) {
    text += static_cast<char>(character);
  } else if (character < 0x800) {
    text += static_cast<char>(0xC0 | character >> 6), text += part(0);
  } else if (character < 0x10000) {
    text += static_cast<char>(0xE0 | character >> 12), text += part(6), text += part(0);
  } else {
    text += static_cast<char>(0xF0 | character >> 18);
    text += part(12), text += part(6), text += part(0);
  }
}

}  // namespace

Archive::Archive(const std::string& path) {
  const File file(path);
  for (const Entry& entry : entries_of(file)) {
    constexpr std::string_view kEnding = ".npy";
    require(entry.name.ends_with(kEnding), "it has a file that is no array");
    const std::string name = entry.name.substr(0, entry.name.size() - kEnding.size());
    require(arrays.emplace(name, read_array(file, entry)).second, "it has an array twice");
  }
}

void Archive::wrong(std::string_view name, const std::string& what) {
  throw std::invalid_argument("its array '" + std::string(name) + "' " + what);
}

const ArchiveArray& Archive::array(std::string_view name) const {
  const auto found = arrays.find(name);
  if (found == arrays.end()) wrong(name, "is missing");
  return found->second;
}

const ArchiveArray& Archive::array(std::string_view name, std::string_view type) const {
  const ArchiveArray& found = array(name);
  if (found.type != type) {
    wrong(name, "must have the type " + std::string(type) + ", got " + found.type);
  }
  return found;
}

std::vector<std::string> Archive::strings(std::string_view name) const {
  const ArchiveArray& found = array(name);
  if (!found.type.starts_with("<U")) wrong(name, "must have strings, got " + found.type);
  std::vector<std::string> strings(found.count);
  const auto characters = Header{std::string_view(found.type).substr(2)}.number();
  const auto* at = reinterpret_cast<const uint32_t*>(found.data.get());
  for (std::string& text : strings) {
    for (int64_t k = 0; k < characters; ++k, ++at) {
      if (*at > 0x10FFFF || (*at >= 0xD800 && *at < 0xE000)) wrong(name, "has no text");
      if (*at != 0) append(text, *at);  // zeros fill the end
    }
  }
  return strings;
}

std::string Archive::text(std::string_view name) const {
  const std::vector<std::string> found = strings(name);
  if (found.size() != 1) wrong(name, "must be one text");
  return found[0];
}

}  // namespace darswin
