#include "tensor_file.h"

#include <fcntl.h>
#include <sys/mman.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <bit>
#include <cerrno>
#include <charconv>
#include <cstdlib>
#include <cstring>
#include <new>
#include <system_error>
#include <utility>

namespace darswin {
namespace {

static_assert(std::endian::native == std::endian::little, "arrays are read as they are stored");

constexpr int64_t kMostBytes = int64_t{1} << 31, kMostHeader = int64_t{1} << 21;
constexpr size_t kMostAxes = 8;
constexpr int64_t kLength = 8;  // bytes of the length of the header
constexpr char kHeader[] = "its header is not as darswin writes it";

void require(bool condition, const char* what = kHeader) {
  if (!condition) throw std::invalid_argument(what);
}

[[noreturn]] void fail(int error) { throw std::system_error(error, std::generic_category()); }

// The bytes of a file: mapped, or read where the system cannot map it.
std::shared_ptr<const char> content_of(const std::string& path, int64_t& size) {
  struct File {
    int descriptor;
    ~File() { close(descriptor); }
  };
  // Without O_NONBLOCK, a pipe would wait for its other end.
  const File file{open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK)};
  if (file.descriptor < 0) fail(errno);
  size = lseek(file.descriptor, 0, SEEK_END);
  require(size >= 0, "it is a pipe, a socket or a device");
  char first;
  if (pread(file.descriptor, &first, 1, 0) < 0) fail(errno);  // it is a folder
  require(size > kLength && size <= kMostBytes, "it is too short or too long");
  void* all = mmap(nullptr, size, PROT_READ, MAP_PRIVATE, file.descriptor, 0);
  const bool is_mapped = all != MAP_FAILED;
  if (!is_mapped) {
    all = mmap(nullptr, size, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if (all == MAP_FAILED) throw std::bad_alloc();
  }
  std::shared_ptr<char> content(static_cast<char*>(all), [size](char* at) { munmap(at, size); });
  for (int64_t at = is_mapped ? size : 0; at < size;) {
    const ssize_t got = pread(file.descriptor, content.get() + at, size - at, at);
    if (got < 0 && errno == EINTR) continue;
    if (got < 0) fail(errno);
    require(got > 0, "it became shorter");
    at += got;
  }
  return content;
}

// The tables of the CRC-32 of zip and PNG: table k is of a byte that k more bytes follow.
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
constexpr uint32_t kWhole = 0x2144DF1C;  // the CRC-32 of bytes that end in their own CRC-32

uint32_t crc_of(std::string_view bytes) {
  uint32_t crc = ~0u;
  for (; bytes.size() >= kSlices; bytes.remove_prefix(kSlices)) {
    uint32_t words[kSlices / 4], sum = 0;
    std::memcpy(words, bytes.data(), kSlices);
    words[0] ^= crc;
    for (int k = 0; k < kSlices; ++k) {
      sum ^= kCrc[kSlices - 1 - k][words[k / 4] >> (k % 4 * 8) & 255];
    }
    crc = sum;
  }
  for (const char byte : bytes) crc = (crc >> 8) ^ kCrc[0][(crc ^ byte) & 255];
  return ~crc;
}

// The bytes of a number of a type; 0 for a type that no array has.
int64_t size_of(std::string_view type) {
  if (type == "I64" || type == "F64") return 8;
  if (type == "I32" || type == "F32") return 4;
  if (type == "I16" || type == "U16") return 2;
  return type == "U8" ? 1 : 0;
}

// Adds a character to a text in UTF-8.
void append(std::string& text, uint32_t character) {
  const auto part = [&](int shift) {
    return static_cast<char>(0x80 | ((character >> shift) & 0x3F));
  };
  if (character < 0x80) {
    text += static_cast<char>(character);
  } else if (character < 0x800) {
    text += {static_cast<char>(0xC0 | character >> 6), part(0)};
  } else if (character < 0x10000) {
    text += {static_cast<char>(0xE0 | character >> 12), part(6), part(0)};
  } else {
    text += {static_cast<char>(0xF0 | character >> 18), part(12), part(6), part(0)};
  }
}

// Reads the JSON of a header from front to back. It is ASCII, and only as deep as headers are.
struct Header {
  std::string_view text;

  char next() {
    require(!text.empty());
    const char first = text[0];
    text.remove_prefix(1);
    return first;
  }
  void skip_space() {
    text.remove_prefix(std::min(text.find_first_not_of(" \t\n\r"), text.size()));
  }
  bool skip(char expected) {
    skip_space();
    if (!text.starts_with(expected)) return false;
    text.remove_prefix(1);
    return true;
  }
  // Calls value() for what is between two brackets and commas.
  template <typename Value>
  void list(char first, char last, Value value) {
    require(skip(first));
    if (skip(last)) return;
    do value();
    while (skip(','));
    require(skip(last));
  }
  std::string name() {
    std::string found = string();
    require(skip(':'));
    return found;
  }
  std::vector<int64_t> numbers() {
    std::vector<int64_t> values;
    list('[', ']', [&] {
      skip_space();
      require(values.size() < kMostAxes);
      values.push_back(number<int64_t>(text.size(), 10));
    });
    return values;
  }
  template <typename T>
  T number(size_t most, int base) {
    T value = 0;
    const auto [end, error] = std::from_chars(text.data(), text.data() + most, value, base);
    require(error == std::errc() && value >= 0);
    text.remove_prefix(end - text.data());
    return value;
  }
  std::string string() {
    std::string result;
    require(skip('"'));
    for (char c = next(); c != '"'; c = next()) {
      require(c >= ' ' && static_cast<uint8_t>(c) < 0x80);
      append(result, c == '\\' ? escaped() : c);
    }
    return result;
  }
  // The character behind a backslash.
  uint32_t escaped() {
    constexpr std::string_view kNames = "\"\\/bfnrt", kCharacters = "\"\\/\b\f\n\r\t";
    const char name = next();
    if (name != 'u') {
      require(kNames.find(name) != kNames.npos);
      return kCharacters[kNames.find(name)];
    }
    const uint32_t high = unit();
    if (high < 0xD800 || high >= 0xE000) return high;
    require(high < 0xDC00 && next() == '\\' && next() == 'u');
    const uint32_t low = unit();
    require(low >= 0xDC00 && low < 0xE000);
    return 0x10000 + ((high & 0x3FF) << 10 | (low & 0x3FF));
  }
  uint32_t unit() {
    const size_t before = text.size();
    const auto value = number<uint32_t>(std::min<size_t>(before, 4), 16);
    require(before - text.size() == 4);
    return value;
  }
};

}  // namespace

TensorFile::TensorFile(const std::string& path) {
  constexpr char kTwice[] = "its header has a name twice",
                 kSizes[] = "its arrays do not have the sizes that its header says";
  int64_t size = 0;
  content = content_of(path, size);
  const std::string_view file(content.get(), size);
  require(crc_of(file) == kWhole, "it is damaged, or of another kind");
  uint64_t length = 0;
  std::memcpy(&length, file.data(), kLength);
  require(length <= kMostHeader && length <= file.size() - kLength && length % 8 == 0,
          "its header has a wrong length");
  const std::string_view data = file.substr(kLength + length);
  // A copy: whoever writes into the file cannot change what was checked.
  const std::string copy(file.substr(kLength, length));
  Header header{copy};
  bool has_texts = false;
  int64_t at = 0;  // the end of the last array
  const auto end = static_cast<int64_t>(data.size());
  header.list('{', '}', [&] {
    std::string name = header.name();
    if (name == "__metadata__") {
      require(!std::exchange(has_texts, true), kTwice);
      header.list('{', '}', [&] {
        std::string key = header.name();
        require(texts.emplace(std::move(key), header.string()).second, kTwice);
      });
      return;
    }
    Tensor tensor{.type = {}, .shape = {}, .count = 1, .data = data.data() + at};
    require(header.skip('{') && header.name() == "dtype");
    tensor.type = header.string();
    require(header.skip(',') && header.name() == "shape");
    tensor.shape = header.numbers();
    require(header.skip(',') && header.name() == "data_offsets");
    const std::vector<int64_t> offsets = header.numbers();
    require(header.skip('}'));
    const int64_t item = size_of(tensor.type);
    require(item > 0, "an array has a type that darswin does not write");
    for (const int64_t count : tensor.shape) {
      require(count <= size, kSizes);  // also beside a 0
      tensor.count *= count;           // of two numbers up to 2^31
      require(tensor.count <= size, kSizes);
    }
    const int64_t bytes = tensor.count * item;
    require(bytes <= end - at && offsets == std::vector{at, at + bytes}, kSizes);
    require(at % item == 0, "an array begins at a place that is no multiple of its numbers' size");
    at += bytes;
    require(tensors.emplace(std::move(name), std::move(tensor)).second, kTwice);
  });
  header.skip_space();
  require(header.text.empty());
  require(at == end, kSizes);
}

void TensorFile::wrong(std::string_view name, const std::string& what) {
  throw std::invalid_argument("its array '" + std::string(name) + "' " + what);
}

const TensorFile::Tensor& TensorFile::tensor(std::string_view name) const {
  const auto found = tensors.find(name);
  if (found == tensors.end()) wrong(name, "is missing");
  return found->second;
}

const TensorFile::Tensor& TensorFile::tensor(std::string_view name, std::string_view type) const {
  const Tensor& found = tensor(name);
  if (found.type != type) {
    wrong(name, "must have the type " + std::string(type) + ", got " + found.type);
  }
  return found;
}

const std::vector<int64_t>& TensorFile::shape(std::string_view name) const {
  return tensor(name).shape;
}

const std::string* TensorFile::find_text(std::string_view name) const {
  const auto found = texts.find(name);
  return found == texts.end() ? nullptr : &found->second;
}

const std::string& TensorFile::text(std::string_view name) const {
  const std::string* found = find_text(name);
  if (found == nullptr) {
    throw std::invalid_argument("its text '" + std::string(name) + "' is missing");
  }
  return *found;
}

}  // namespace darswin
